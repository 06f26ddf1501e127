"""What a compiled or exported program calls as a whole: choices and iterations that depend on values.

``torch.compile`` and ``torch.export`` record which operations run, and cannot record branches on values. Landmarks and
the balancing are operators of ``torch.ops.nlfilter`` to them, which run here as they do without a compiler. Neither has
a derivative of its own: landmarks are means with the choice held, the balancing is differentiated at its solution.
"""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.autograd import once_differentiable
from nlfilter_torch.core.checks import warn
from nlfilter_torch.core.communicator import ALONE
from nlfilter_torch.core.kernels.library import register
from nlfilter_torch.operator.balancing import Rounds, balance_in_rounds, implicit_gradients, solve, warn_of_residual
from nlfilter_torch.operator.eigenvalue_bound import exceeds, shifted_gram, slack
from nlfilter_torch.operator.landmarks import Sampling, candidate_count, candidate_pixels, clusters, means_of_clusters
from nlfilter_torch.operator.scaling import Balancing, KernelMatrix


def _never(*_: Any) -> None:
    """There is no kernel in C."""


def _fake_choice(features: Tensor, height: int, width: int, count: int, sampling: str) -> tuple[Tensor, ...]:
    batch, candidates = features.shape[0], candidate_count(height * width, count, sampling)
    shapes = (candidates,), (batch, 1, count), (batch, candidates)
    return tuple(features.new_empty(shape, dtype=torch.long) for shape in shapes)


@register(
    "choose(Tensor features, int height, int width, int count, str sampling) -> (Tensor, Tensor, Tensor)",
    _never,
    _fake_choice,
)
def choose(features: Tensor, height: int, width: int, count: int, sampling: Sampling) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates (S,), those that clusters start from (B, 1, M) and the cluster of each (B, S)."""
    generator = torch.Generator().manual_seed(0)
    pixels = candidate_pixels((height, width), count, sampling, generator).to(features.device)
    if len(pixels) == count:
        _, start, assignment = _fake_choice(features, height, width, count, sampling)
        return pixels, start.zero_(), assignment.zero_()
    start, assignment = clusters(ALONE.columns(features, pixels), count, generator)
    return pixels, start, assignment


def choose_in_graph(features: Tensor, size: tuple[int, int], count: int, sampling: Sampling) -> Tensor:
    """:func:`choose_landmarks` as a compiler records it, with the landmarks of a call without a generator."""
    if count == features.shape[2]:
        return features
    pixels, start, assignment = choose(features.detach(), size[0], size[1], count, sampling)
    subset = ALONE.columns(features, pixels)
    return subset if pixels.shape[0] == count else means_of_clusters(subset, assignment, start)


def _fake_settled(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, ...]:
    batch, landmarks, _ = factor.shape
    moments = factor.new_empty(Rounds.MOST + 1, batch, landmarks, 1, dtype=torch.float64)
    inverse = factor.new_empty(batch, landmarks, landmarks, dtype=torch.float64)
    removed = torch.empty_like(diagonal, dtype=torch.bool)
    return torch.empty_like(diagonal), moments, factor.new_empty(batch), inverse, removed


@register(
    "settle(Tensor factor, Tensor diagonal, float tolerance, bool completed, bool bound) "
    "-> (Tensor, Tensor, Tensor, Tensor, Tensor)",
    _never,
    _fake_settled,
)
def settle(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Balance a kernel: d (B, N), moments, residual (B,), inverse of the Jacobian, and the pixels that it removed.

    The moments, one more than there may be rounds, are those of the rounds and the last one repeated. If eigenvalues
    shall be ``bound`` and exceed 1, it warns.
    """

    def balanced(factor: Tensor, diagonal: Tensor) -> tuple[Any, float]:
        found = solve(KernelMatrix(factor, diagonal), tolerance, completed)
        warn_of_residual(found.residual, tolerance, factor.dtype, completed=completed)
        return found, float(found.residual.max()) if factor.device.type == "cpu" else 0.0

    rounds = balance_in_rounds(factor, diagonal, balanced, completed=completed and factor.device.type == "cpu")
    found, factor, diagonal = rounds.found, rounds.factor, rounds.diagonal
    if bound and factor.device.type == "cpu":
        remainder = found.scaling * (found.scaling * diagonal)
        gram = shifted_gram(factor, found.scaling, remainder, ALONE)
        if exceeds(gram, found.moment, slack(factor.dtype, rounds.residual)):
            warn("eigenvalues exceed 1, which compiled programs do not correct; use landmarks='kmeans'")
    moments = [*rounds.before, *[found.moment] * (Rounds.MOST + 1 - len(rounds.before))]
    removed = torch.zeros_like(diagonal, dtype=torch.bool) if rounds.removed is None else rounds.removed
    return found.scaling, torch.stack(moments), found.residual, found.inverse.contiguous(), removed


def balance_in_graph(
    factor: Tensor, diagonal: Tensor, tolerance: float, completed: bool, bound: bool
) -> tuple[Tensor, Tensor, Balancing, tuple[Tensor, ...]]:
    """Factor and diagonal without isolated pixels, their balancing, and the moments that found these pixels."""
    scaling, moments, residual, inverse, removed = settle(
        factor.detach(), diagonal.detach(), tolerance, completed, bound
    )
    factor, diagonal = factor * ~removed.unsqueeze(1), torch.where(removed, 1.0, diagonal)
    scaling = _Settled.apply(factor, diagonal, scaling, moments[-1], inverse, completed)  # type: ignore[no-untyped-call]
    return factor, diagonal, Balancing(scaling, moments[-1], residual, 0), moments[:-1].unbind()


class _Settled(torch.autograd.Function):
    """A solution d (B, N) of the balancing, which is differentiated in the factor and the diagonal."""

    @staticmethod
    def forward(
        ctx: Any, factor: Tensor, diagonal: Tensor, scaling: Tensor, moment: Tensor, inverse: Tensor, completed: bool
    ) -> Tensor:
        scaling = scaling.clone()
        ctx.save_for_backward(factor, diagonal, scaling, moment, inverse)
        ctx.completed = completed
        return scaling

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        factor, diagonal, scaling, moment, inverse = ctx.saved_tensors
        matrix, solution = KernelMatrix(factor, diagonal, None, ALONE), Balancing(scaling, moment, scaling, 0)
        gradients = implicit_gradients(matrix, solution, inverse, grad, ctx.completed)
        return *gradients, None, None, None, None
