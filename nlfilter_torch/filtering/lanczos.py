"""Functions of W for an image by the method of Lanczos, for responses that no low rational function approximates.

The space of ``y, W y, W^2 y, ...`` has an orthonormal basis Q in which W is a tridiagonal matrix T, and ``f(W) y`` is
about ``|y| Q f(T) e_1``: nearly the best that as many products can give, for any f, and exact once the eigenvalues on
either side of a step are resolved. Every new vector is made orthogonal to all earlier ones twice, since the recurrence
of three terms alone loses orthogonality. The derivative in W uses the spaces of the image and of the incoming gradient
(Kandolf, Koskela, Relton and Schweitzer, "Computing low-rank approximations of the Frechet derivative of a matrix
function using Krylov subspace methods", 2021).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.checks import Response
from nlfilter_torch.core.precision import Gradients
from nlfilter_torch.core.symmetric_matrix import MEETING, divided_differences
from nlfilter_torch.operator.pixel_matrix import PixelMatrix

CHUNK = 16  # steps between two estimates of the error
EARLIER = 0.75  # share of the steps whose result the last one is compared with
STEPS = (128, 1024)  # limits of the number of steps for large and small images
ROUNDING_LENGTHS = 50  # lengths of a new vector, in units of rounding, that count as zero
BASIS = 1 << 26  # numbers in the basis of a plane up to which steps are not limited to the lower limit


@dataclass(frozen=True, eq=False)
class RitzSpace:
    """What the Krylov spaces of planes (B, C, N) know of W.

    Attributes:
        basis: Q, (B, C, k, N), orthonormal rows in the sum over points with their weights.
        values: eigenvalues of T, (B, C, k) in float64.
        vectors: eigenvectors of T, columns, (B, C, k, k).
        start: coefficients of the planes in the eigenvectors, ``|y| S^T e_1``, (B, C, k).
    """

    basis: Tensor
    values: Tensor
    vectors: Tensor
    start: Tensor

    def combine(self, gains: Tensor) -> Tensor:
        """``Q f(T) Q^T y``, (B, C, N), for gains f (B, C, k) of the eigenvalues."""
        return _rows(self.vectors @ (gains * self.start).unsqueeze(3), self.basis)


def _rows(inner: Tensor, basis: Tensor) -> Tensor:
    """Combine the rows of a basis (B, C, k, N) with coefficients (B, C, k, 1)."""
    return (inner.mT.to(basis) @ basis).squeeze(2)


class Lanczos:
    """The iteration for planes (B, C, N)."""

    def __init__(self, matrix: PixelMatrix, planes: Tensor) -> None:
        """Start with the planes."""
        self.matrix = matrix
        length = self._inner(planes.unsqueeze(2), planes).squeeze(2).clamp(min=0.0).sqrt()  # (B, C)
        self.length = length
        self._basis = _normalised(planes, length).unsqueeze(2)  # (B, C, k + 1, N), with room for more
        self._diagonal: list[Tensor] = []
        self._beside: list[Tensor] = []

    @property
    def steps(self) -> int:
        """Number of products with W so far."""
        return len(self._diagonal)

    def _inner(self, basis: Tensor, planes: Tensor) -> Tensor:
        """Inner products (B, C, k) in float64 of planes (B, C, N) with a basis (B, C, k, N)."""
        mass = weighted(planes, self.matrix.weights).unsqueeze(3)
        return self.matrix.communicator.sum((basis @ mass).squeeze(3).double())

    def extend(self, count: int) -> None:
        """Take further steps."""
        room = self._basis.new_empty(*self._basis.shape[:2], count, self._basis.shape[3])
        self._basis = torch.cat([self._basis, room], dim=2)
        for _ in range(count):
            self._step(self._basis[:, :, : self.steps + 1])

    def _step(self, basis: Tensor) -> None:
        """Add a vector to the basis (B, C, k, N)."""
        last = basis[:, :, -1]
        following = self.matrix.product(last)
        inner = self._inner(basis, following)
        alive = self._inner(basis[:, :, -1:], last).squeeze(2) > 0.5
        following = following - _rows(inner.unsqueeze(3), basis)
        following = following - _rows(self._inner(basis, following).unsqueeze(3), basis)
        length = self._inner(following.unsqueeze(2), following).squeeze(2).clamp(min=0.0).sqrt()
        length = torch.where(length > ROUNDING_LENGTHS * torch.finfo(following.dtype).eps, length, 0.0)
        self._basis[:, :, basis.shape[2]] = _normalised(following, length)
        # An exhausted space is continued by zeros, with eigenvalues of 1 that nothing is coupled to.
        self._diagonal.append(torch.where(alive, inner[:, :, -1], 1.0))
        self._beside.append(length)

    def space(self, steps: int | None = None) -> RitzSpace:
        """The space after ``steps`` steps; None for all."""
        steps = self.steps if steps is None else steps
        matrix = torch.diag_embed(torch.stack(self._diagonal[:steps], dim=2))
        if steps > 1:
            beside = torch.diag_embed(torch.stack(self._beside[: steps - 1], dim=2), offset=1)
            matrix = matrix + beside + beside.mT
        values, vectors = torch.linalg.eigh(matrix)
        start = self.length.unsqueeze(2) * vectors[:, :, 0]
        return RitzSpace(self._basis[:, :, :steps], values.clamp(0.0, 1.0), vectors, start)


def _normalised(planes: Tensor, length: Tensor) -> Tensor:
    length = length.unsqueeze(2).to(planes)
    return torch.where(length > 0, planes / torch.where(length > 0, length, 1.0), 0.0)


def gains_of(response: Response, values: Tensor) -> Tensor:
    """Gains (B, C, k) of eigenvalues (B, C, k) by a function from (B, R) to (B, R)."""
    return response(values.flatten(1)).view_as(values)


@torch.no_grad()
def ritz_space(matrix: PixelMatrix, planes: Tensor, response: Response, tolerance: float) -> tuple[RitzSpace, float]:
    """Take steps until an estimate of the error of ``f(W) y``, relative to the largest value of y, is small.

    The estimate is the largest difference between the results of all steps and of three quarters of them.

    Returns:
        The space, and the estimate.
    """
    pixels = matrix.communicator.pixels(planes.shape[2])
    most = min(pixels, max(STEPS[0], min(STEPS[1], BASIS // pixels)))
    iteration, error = Lanczos(matrix, planes), float("inf")
    scale = matrix.communicator.max(planes.abs().amax((1, 2))).clamp(min=torch.finfo(planes.dtype).tiny)
    while True:
        iteration.extend(min(CHUNK, most - iteration.steps))
        space = iteration.space()
        if iteration.steps == pixels:
            return space, torch.finfo(planes.dtype).eps
        earlier = iteration.space(int(EARLIER * iteration.steps))
        change = (s.combine(gains_of(response, s.values)) for s in (space, earlier))
        difference = (next(change) - next(change)).abs().amax((1, 2))
        error = float((matrix.communicator.max(difference) / scale).max())
        if error <= tolerance or iteration.steps >= most:
            return space, error


def krylov_product(matrix: PixelMatrix, planes: Tensor, response: Response, space: RitzSpace) -> Tensor:
    """``f(W) y`` in a Krylov space of the planes, (B, C, N); differentiable once in y, f and W."""
    gains = matrix.communicator.copy_to_group(gains_of(response, space.values))
    return matrix.apply(_Krylov(space, response), planes, gains)


@dataclass(frozen=True, eq=False)
class _Krylov:
    """The function of W with a response f in a Krylov space of the planes; gains are those of the values of W."""

    space: RitzSpace
    response: Response

    def value(self, matrix: PixelMatrix, planes: Tensor, gains: Tensor) -> Tensor:
        """The product with planes."""
        return self.space.combine(gains).to(planes)

    def gradients(
        self, matrix: PixelMatrix, planes: Tensor, gains: Tensor, grad: Tensor, needed: Sequence[bool]
    ) -> Gradients:
        """Those of W and planes from the Krylov space of the gradient, with as many steps."""
        space, weights, nothing = self.space, matrix.weights, (None, None, None)
        inner = (space.basis @ grad.unsqueeze(3)).squeeze(3).double()  # (B, C, k)
        grad_gains = (space.vectors.mT @ inner.unsqueeze(3)).squeeze(3) * space.start
        if not any(needed[:4]):
            return *nothing, None, grad_gains
        # W is symmetric in the sum over points with their weights, in which the gradient is grad / weights.
        pulled = (
            grad
            if weights is None
            else torch.where(
                weights.unsqueeze(1) > 0, grad / weights.unsqueeze(1).clamp(min=torch.finfo(grad.dtype).tiny), 0.0
            )
        )
        iteration = Lanczos(matrix, pulled)
        iteration.extend(space.values.shape[2])
        adjoint = iteration.space()
        with torch.no_grad():
            answers = gains_of(self.response, adjoint.values)
        grad_planes = weighted(adjoint.combine(answers).to(planes), weights)
        if not any(needed[:3]):
            return *nothing, grad_planes, grad_gains
        differences = divided_differences(
            self.response, (adjoint.values, answers), (space.values, gains), meeting=MEETING[answers.dtype]
        )
        inner = adjoint.start.unsqueeze(3) * differences * space.start.unsqueeze(2)
        core = adjoint.vectors @ inner @ space.vectors.mT
        left = weighted((core.mT.to(planes) @ adjoint.basis).flatten(1, 2), weights)
        return *matrix.gradient(left, space.basis.flatten(1, 2)), grad_planes, grad_gains
