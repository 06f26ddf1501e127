"""Blocks of pixels to the few sums over all of them that a filter consists of, in passes, with no vector of pixels.

With ``u`` the columns of the factor and ``c`` the diagonal, balancing is the equation ``t = sum_i u_i d_i(t)`` for the
moment t (M numbers), since the scaling ``d_i`` of a pixel is a closed form of ``u_i . t`` and ``c_i``. Its Jacobian
``I + F diag(1 / (1 + r)) F^T`` is symmetric with eigenvalues in [1, 2] and is summed up in the same pass, so that
Newton's method needs two or three passes. With t known, one pass more gives ``G_j = F diag(r^j) F^T`` and ``b_i =
F r^i y``, and from them all coefficients of ``W^i y = F^T c_i + r W^(i-1) y``: ``c_1 = b_0``, ``c_(i+1) = sum_j G_j
c_(i-j) + b_i``.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.checks import warn
from nlfilter_torch.core.kernels.grams import sum_grams
from nlfilter_torch.core.kernels.tall_skinny import moment
from nlfilter_torch.operator.balancing import balance
from nlfilter_torch.operator.eigenvalue_bound import exceeds, limiter, shift, slack
from nlfilter_torch.operator.newton import LARGEST
from nlfilter_torch.operator.operator import Columns
from nlfilter_torch.operator.scaling import PixelScaling, scaling_from_moment

CONVERGED = {torch.float32: 1e-5, torch.float64: 1e-7}  # a step of that size, relative to t, leaves its square
MAX_PASSES = 12
ALARM = 1e-3


@dataclass(frozen=True)
class Block:
    """Some pixels: factor (1, M, n), diagonal (1, n), colours (1, C, n), and how many each stands for, (1, n)."""

    factor: Tensor
    diagonal: Tensor
    image: Tensor
    weights: Tensor


Pass = Callable[[], Iterator[Block]]


def start_balancing(factor: Tensor, diagonal: Tensor, weight: float) -> Tensor:
    """The moment t (1, M, 1), in float64, of an image from a sample whose pixels stand for ``weight`` pixels each."""
    # With d = e / sqrt(w) the weighted equation is that of the sample alone, for e and a smaller diagonal.
    scaling = balance(factor, diagonal / weight, tolerance=1e-3).scaling
    return weight**0.5 * moment(factor, scaling.unsqueeze(1))


def balance_by_passes(blocks: Pass, total: Tensor, *, completed: bool) -> Tensor:
    """The moment t (1, M, 1) of the pixels in ``blocks``, from a first guess ``total``.

    ``completed``: the kernel has a unit diagonal and no negative entry, so that no scaling can be large. A guess that
    knows nothing of some pixels would give them one, and Newton's method would only halve it with every pass.
    """
    largest = LARGEST if completed else float("inf")
    identity = torch.eye(total.shape[1], dtype=total.dtype, device=total.device)
    change = float("inf")
    for _ in range(MAX_PASSES):
        sums, jacobian = torch.zeros_like(total), identity.expand(total.shape[0], -1, -1).clone()
        tolerance = 0.0
        for block in blocks():
            tolerance = CONVERGED[block.factor.dtype]
            scaling = scaling_from_moment(block.factor, block.diagonal, total.to(block.factor)).clamp(max=largest)
            remainder = scaling * (scaling * block.diagonal)
            sums += moment(block.factor, (block.weights * scaling).unsqueeze(1))
            weights = scaling * (block.weights / (1 + remainder)).sqrt()
            jacobian += sum_grams(block.factor, weights, remainder, 1)[:, 0]
        step = torch.cholesky_solve(sums - total, torch.linalg.cholesky_ex(jacobian).L)
        total = total + step
        change = float(step.norm() / total.norm())
        if change <= tolerance:
            return total
    if change > ALARM:
        warn(
            f"balancing still changed by {change:.1e} after {MAX_PASSES} passes; "
            "raise photometric_bandwidth or num_landmarks, or use completion='diagonal'"
        )
    return total


def limiter_by_passes(blocks: Pass, balancing: PixelScaling) -> Tensor | None:
    """The ``X^(1/2)`` (1, M, M) by which the factor is multiplied, or None where no eigenvalue exceeds 1."""
    dtype = next(iter(blocks())).factor.dtype

    def gram(at: Tensor, power: int) -> Tensor:
        matrix = torch.zeros((), dtype=torch.float64)
        for block in blocks():
            scaling, remainder = balancing(block.factor, block.diagonal)
            weights = block.weights * shift(at, remainder).pow(-power)
            matrix = matrix + sum_grams(block.factor, (scaling * weights.sqrt()).to(block.factor), None, 1)[:, 0]
        return matrix

    allowed = slack(dtype, CONVERGED[dtype])
    return limiter(gram, balancing.moment, allowed) if exceeds(gram, balancing.moment, allowed) else None


@dataclass(frozen=True)
class Sums:
    """What a pass over a balanced image leaves.

    Attributes:
        grams: ``F diag(r^j) F^T``, (1, J, M, M), float64.
        moments: ``F r^i y``, (1, k, M, C), float64.
        dtype: of the factor.
    """

    grams: Tensor
    moments: Tensor
    dtype: torch.dtype

    def coefficients(self) -> Tensor:
        """The c_i of ``W^i y = F^T c_i + r W^(i-1) y`` for i = 1 ... k, (1, k, M, C)."""
        found = [self.moments[:, 0]]
        for i in range(1, self.moments.shape[1]):
            found.append(self.moments[:, i] + sum(self.grams[:, j] @ found[i - 1 - j] for j in range(i)))
        return torch.stack(found, dim=1)


def sum_up(pixels: Iterable[tuple[Tensor, Columns, Tensor]], order: int) -> Sums:
    """One pass over pixels, for the first ``order`` powers of W.

    Args:
        pixels: values y (1, C, n) to filter, columns, and how many pixels each stands for, (1, n).
        order: k, at least 1.
    """
    grams, moments, dtype = torch.zeros(()), torch.zeros(()), torch.float64
    for values, columns, weights in pixels:
        factor, scaling, remainder = columns.factor, columns.scaling, columns.remainder
        grams = grams + sum_grams(factor, scaling * weights.sqrt(), remainder, max(order - 1, 2))
        powers = [(scaling * weights).unsqueeze(1) * values]
        for _ in range(order - 1):
            powers.append(remainder.unsqueeze(1) * powers[-1])
        sums = moment(factor, torch.cat(powers, dim=1))  # (1, M, k C)
        moments = moments + sums.unflatten(2, (order, -1)).transpose(1, 2)
        dtype = factor.dtype
    return Sums(grams, moments, dtype)
