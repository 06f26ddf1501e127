"""The sums over pixels that define a filter, in passes over blocks of pixels, without vectors of length N.

With ``u`` the columns of the factor and ``c`` the diagonal, balancing is the equation ``t = sum_i u_i d_i(t)`` for the
moment t (M numbers), since the scaling ``d_i`` of a pixel is a closed form of ``u_i . t`` and ``c_i``. Its Jacobian
``I + F diag(1 / (1 + r)) F^T`` is symmetric with eigenvalues in [1, 2] and is computed in the same pass, so that
Newton's method needs two or three passes. Given t, one more pass computes ``G_j = F diag(r^j) F^T`` and ``b_i =
F r^i y``, and from them all coefficients of ``W^i y = F^T c_i + r W^(i-1) y``: ``c_1 = b_0``, ``c_(i+1) = sum_j G_j
c_(i-j) + b_i``.

Each of these equations has the form ``x = f(x)``, where f is a sum over all pixels. A single pass computes f at an
initial guess, and a sample estimates how f changes from there: ``x = f(guess) + s(x) - s(guess)``, where s estimates f.
The error is the error of the sample times that of the guess.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.grams import sum_grams
from nlfilter_torch.core.kernels.tall_skinny import moment, positive_root, spread
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.columns import Columns
from nlfilter_torch.operator.eigenvalue_bound import exceeds, limiter, shift, slack
from nlfilter_torch.operator.pixel_matrix import capacitance_inverse, shifted_gram, shifted_remainder
from nlfilter_torch.operator.scaling import LARGEST, KernelMatrix, Pass, PixelScaling, newton

CONVERGED = {
    torch.float32: 1e-5,
    torch.float64: 1e-7,
}  # relative Newton step; the error after it is its square
MAX_PASSES = 12
ALARM = 1e-3


@dataclass(frozen=True, eq=False)
class Block(KernelMatrix):
    """A block of pixels in a pass.

    Attributes:
        weights: number of pixels that each represents, (1, n).
        image: their colours, (1, C, n).
        start_row: row of the first pixel in the picture.
    """

    weights: Tensor
    image: Tensor = field(kw_only=True)
    start_row: int = 0

    @staticmethod
    def concatenate(parts: list["Block"]) -> "Block":
        """Several blocks as one."""
        factors, diagonals, weights, images = zip(
            *((part.factor, part.diagonal, part.weights, part.image) for part in parts), strict=True
        )
        return Block(torch.cat(factors, 2), torch.cat(diagonals, 1), torch.cat(weights, 1), image=torch.cat(images, 2))


def balance_by_passes(
    blocks: Pass[Block], total: Tensor, dtype: torch.dtype, *, completed: bool, bias: Tensor | float = 0.0
) -> Tensor:
    """Solve for the moment t (1, M, 1) of the pixels in ``blocks``, from an initial guess ``total``.

    ``bias`` is added to the sum over the blocks. ``completed`` means that the kernel has a unit diagonal and no
    negative entry, so that no scaling can be large.
    """
    most = LARGEST if completed else float("inf")
    total, _, change = newton(blocks, total, steps=MAX_PASSES, most=most, bias=bias, tolerance=CONVERGED[dtype])
    if change > ALARM:
        warn(
            f"balancing still changed by {float(change):.1e} after {MAX_PASSES} passes; "
            "raise photometric_bandwidth or num_landmarks, or use completion='diagonal'"
        )
    return total


@dataclass(frozen=True)
class GramByPasses:
    """Computes ``F (x I - R)^-k F^T`` in a pass over the pixels for each x and k."""

    blocks: Pass[Block]
    pixel_scaling: PixelScaling

    def __call__(self, at: Tensor, power: int) -> Tensor:
        """The sum for x, of shape (1,), and k."""
        return torch.stack(list(self.blocks(partial(self._of_block, at, power)))).sum(0)

    def _of_block(self, at: Tensor, power: int, block: Block) -> Tensor:
        scaling, remainder = self.pixel_scaling(block.factor, block.diagonal)
        weights = block.weights * shift(at, remainder).pow(-power)
        return sum_grams(block.factor, (scaling * weights.sqrt()).to(block.factor), None, 1)[:, 0]


def limiter_by_passes(blocks: Pass[Block], pixel_scaling: PixelScaling, dtype: torch.dtype) -> Tensor | None:
    """Compute the ``X^(1/2)`` (1, M, M) to multiply the factor by, or None if no eigenvalue exceeds 1."""
    gram, allowed = GramByPasses(blocks, pixel_scaling), slack(dtype, CONVERGED[dtype])
    return limiter(gram, pixel_scaling.moment, allowed) if exceeds(gram, pixel_scaling.moment, allowed) else None


@dataclass(frozen=True)
class Sums:
    """Sums from a pass over a balanced image.

    Attributes:
        grams: ``F diag(r^j) F^T``, (1, J, M, M), float64.
        moments: ``F r^i y``, (1, k, M, C), float64.
        dtype: of the factor.
        correction: added to the moments if they are sums over a sample, (1, k, M, C), float64.
    """

    grams: Tensor
    moments: Tensor
    dtype: torch.dtype
    correction: Tensor | None = None

    def coefficients(self) -> Tensor:
        """The c_i of ``W^i y = F^T c_i + r W^(i-1) y`` for i = 1 ... k, (1, k, M, C)."""
        known = self.moments if self.correction is None else self.moments + self.correction
        coefficients = [known[:, 0]]
        for i in range(1, known.shape[1]):
            coefficients.append(known[:, i] + sum(self.grams[:, j] @ coefficients[i - 1 - j] for j in range(i)))
        return torch.stack(coefficients, dim=1)


@dataclass(frozen=True)
class Totals:
    """Sums over pixels for a guess at the balancing and at the coefficients of powers of W.

    Attributes:
        moment: ``sum_i w_i d_i u_i``, (1, M, 1), float64.
        coefficients: ``F W^(i-1) y`` for i = 1 ... k, (1, k, M, C), float64.
        grams: ``F diag(r^j) F^T``, (1, 2, M, M), float64, or 0 if they are not needed.
    """

    moment: Tensor
    coefficients: Tensor
    grams: Tensor

    def plus(self, other: "Totals", sign: int = 1) -> "Totals":
        """The sum of both, or their difference."""
        return Totals(
            self.moment + sign * other.moment,
            self.coefficients + sign * other.coefficients,
            self.grams + sign * other.grams,
        )


@dataclass(frozen=True)
class Guess:
    """An initial guess of the balancing, and of the coefficients of all powers of W but the last.

    Attributes:
        moment: t, (1, M, 1).
        coefficients: (1, k - 1, M, C).
        values: computes the planes y (1, C, n) of a block, given its columns.
        spectral: whether Gram matrices are needed.
    """

    moment: Tensor
    coefficients: Tensor
    values: Callable[[Block, Columns], Tensor]
    spectral: bool

    def columns(self, block: Block, half: Tensor | None = None) -> Columns:
        """The columns of a block; ``half`` is ``u . t / 2``, (1, n), if known."""
        if half is None:
            half = spread((self.moment / 2).mT.to(block.factor), block.factor).squeeze(1)
        scaling = positive_root(half, block.diagonal).clamp_(max=LARGEST)  # large where the guess misses a pixel
        return Columns(block.factor, scaling, scaling * (scaling * block.diagonal))

    def totals(self, block: Block) -> tuple[Columns, Totals]:
        """The columns of a block, and its contribution to the sums."""
        factor, (order, _, count) = block.factor, self.coefficients.shape[1:]
        rows = torch.cat([(self.moment / 2).mT, self.coefficients.transpose(2, 3).flatten(1, 2)], dim=1)
        products = spread(rows.to(factor), factor)  # the factor is read once
        columns = self.columns(block, products[:, 0])
        powers = [self.values(block, columns)]
        for product in products[:, 1:].unflatten(1, (order, count)).unbind(1):
            powers.append(columns.scaling.unsqueeze(1) * product + columns.remainder.unsqueeze(1) * powers[-1])
        mass = (block.weights * columns.scaling).unsqueeze(1)
        sums = moment(factor, torch.cat([mass, *(mass * power for power in powers)], dim=1))  # (1, M, 1 + k C)
        grams = torch.zeros(1, 1, factor.shape[1], factor.shape[1])
        if self.spectral:
            grams = sum_grams(factor, columns.scaling * block.weights.sqrt(), columns.remainder, 2)
        coefficients = sums[:, :, 1:].unflatten(2, (len(powers), -1)).transpose(1, 2)
        return columns, Totals(sums[:, :, :1], coefficients, grams)


@dataclass(frozen=True)
class ShiftedSums:
    """What solves systems ``(W + t_j) x = y`` for a few shifts t, see :mod:`nlfilter_torch.operator.pixel_matrix`.

    Attributes:
        grams: ``F (R + t_j)^-1 F^T``, (1, J, M, M), float64.
        moments: ``F (R + t_j)^-1 y``, (1, J, M, C), float64.
    """

    grams: Tensor
    moments: Tensor

    def inner(self) -> Tensor:
        """Coefficients of the factor, (1, J, M, C): ``t_j x = t_j (R + t_j)^-1 (y - F^T c_j)``."""
        return capacitance_inverse(self.grams) @ self.moments


@dataclass(frozen=True)
class ShiftedTerms:
    """The sums of a block for shifts t, (J,); ``values`` computes its planes y (1, C, n) and its columns."""

    values: Callable[[Block], tuple[Tensor, Columns]]
    shifts: Tensor
    exact: bool

    def __call__(self, block: Block) -> ShiftedSums:
        """Gram matrices and moments."""
        planes, columns = self.values(block)
        scaling, shifts = columns.scaling * block.weights.sqrt(), self.shifts.to(columns.remainder)
        grams = [
            shifted_gram(columns.factor, scaling, columns.remainder, shift, exact=self.exact)
            for shift in shifts.unbind()
        ]
        lowered = shifted_remainder(columns.remainder, shifts) / shifts.view(1, -1, 1, 1)  # (1, J, 1, n)
        mass = (columns.scaling * block.weights).unsqueeze(1)
        moments = moment(columns.factor, (mass.unsqueeze(1) * lowered * planes.unsqueeze(1)).flatten(1, 2))
        return ShiftedSums(torch.stack(grams, dim=1), moments.unflatten(2, (len(shifts), -1)).transpose(1, 2))


def sum_up_shifted(blocks: Pass[Block], terms: ShiftedTerms) -> ShiftedSums:
    """Compute the sums for shifted systems, in one pass over blocks of pixels."""
    grams, moments = torch.zeros(()), torch.zeros(())
    for sums in blocks(terms):
        grams, moments = grams + sums.grams, moments + sums.moments
    return ShiftedSums(grams, moments)


def sum_up(blocks: Pass[Block], values: Callable[[Block], tuple[Tensor, Columns]], order: int) -> Sums:
    """Compute the sums for the first ``order`` powers of W, in one pass over blocks of pixels.

    ``values`` computes the planes y (1, C, n) to filter in a block, and its columns.
    """
    grams, moments, dtype = torch.zeros(()), torch.zeros(()), torch.float64
    for gram, sums, dtype in blocks(partial(_sums_of_block, values, order)):  # noqa: B007
        grams, moments = grams + gram, moments + sums
    return Sums(grams, moments, dtype)


def _sums_of_block(
    values: Callable[[Block], tuple[Tensor, Columns]], order: int, block: Block
) -> tuple[Tensor, Tensor, torch.dtype]:
    """Gram matrices, moments and dtype of a block, for :func:`sum_up`."""
    planes, columns = values(block)
    factor, scaling, remainder = columns.factor, columns.scaling, columns.remainder
    grams = sum_grams(factor, scaling * block.weights.sqrt(), remainder, max(order - 1, 2))
    powers = [(scaling * block.weights).unsqueeze(1) * planes]
    for _ in range(order - 1):
        powers.append(remainder.unsqueeze(1) * powers[-1])
    sums = moment(factor, torch.cat(powers, dim=1))  # (1, M, k C)
    return grams, sums.unflatten(2, (order, -1)).transpose(1, 2), factor.dtype
