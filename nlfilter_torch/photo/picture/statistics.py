"""The sums over pixels that define a filter, in passes over blocks of pixels, without vectors of length N.

Newton's method for the moment t of the balancing needs two or three passes, as its Jacobian is computed in the same
pass. Given t, one more pass computes ``G_j = F diag(r^j) F^T`` and ``b_i = F r^i y``, and from them all coefficients of
``W^i y = F^T c_i + r W^(i-1) y``: ``c_1 = b_0``, ``c_(i+1) = sum_j G_j c_(i-j) + b_i``.

Each of these equations has the form ``x = f(x)``, where f is a sum over all pixels. A single pass computes f at an
initial guess, and a sample estimates how f changes from there: ``x = f(guess) + s(x) - s(guess)``, where s estimates f.
The error is the error of the sample times that of the guess.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.tall_skinny import positive_root, spread
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.scaling import LARGEST_ROOT, KernelMatrix, Pass, newton

# Relative Newton step at which to stop; the error after it is its square.
CONVERGED = {torch.float32: 1e-5, torch.float64: 1e-7}
MAX_PASSES = 12  # two or three are usual
UNSETTLED = 1e-3  # relative Newton step after the last pass from which on there is a warning


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
    def concatenate(parts: Sequence["Block"]) -> "Block":
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
    most = LARGEST_ROOT if completed else float("inf")
    total, _, change = newton(blocks, total, steps=MAX_PASSES, most=most, bias=bias, tolerance=CONVERGED[dtype])
    if change > UNSETTLED:
        warn(
            f"balancing still changed by {change:.1e} after {MAX_PASSES} passes; "
            "raise photometric_bandwidth or num_landmarks, or use completion='diagonal'"
        )
    return total


@dataclass(frozen=True)
class Sums:
    """Sums from a pass over a balanced image.

    Attributes:
        grams: ``F diag(r^j) F^T``, (1, J, M, M), float64.
        moments: ``F r^i y``, (1, k, M, C), float64.
    """

    grams: Tensor
    moments: Tensor

    def coefficients(self) -> Tensor:
        """The c_i of ``W^i y = F^T c_i + r W^(i-1) y`` for i = 1 ... k, (1, k, M, C)."""
        coefficients = [self.moments[:, 0]]
        for i in range(1, self.moments.shape[1]):
            coefficients.append(self.moments[:, i] + sum(self.grams[:, j] @ coefficients[i - 1 - j] for j in range(i)))
        return torch.stack(coefficients, dim=1)


def sums_of_powers(columns: Columns, planes: Tensor, order: int) -> tuple[Tensor, Tensor]:
    """The :class:`Sums` over some columns for the first ``order`` powers of W, and planes (1, C, n) of their pixels."""
    powers = [planes]
    for _ in range(order - 1):
        powers.append(columns.remainder.unsqueeze(1) * powers[-1])
    moments = columns.sums(torch.cat(powers, dim=1)).unflatten(2, (order, -1)).transpose(1, 2)
    return columns.grams(max(order - 1, 2)), moments


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
        half = block.affinities(self.moment / 2) if half is None else half
        scaling = positive_root(half, block.diagonal).clamp_(max=LARGEST_ROOT)  # large where the guess misses a pixel
        return Columns(block.factor, scaling, scaling * (scaling * block.diagonal), block.weights)

    def totals(self, block: Block) -> tuple[Columns, tuple[Tensor, ...]]:
        """The columns of a block, and its contributions to three sums at the guess.

        They are the moment (1, M, 1), the coefficients ``F W^(i-1) y`` for i = 1 ... k, (1, k, M, C), and Gram matrices
        (1, 2, M, M), or 0 if they are not needed; in float64.
        """
        inner = self.coefficients.transpose(1, 2)  # (1, M, k - 1, C)
        rows = torch.cat([self.moment / 2, inner.flatten(2)], dim=2).mT
        products = spread(rows.to(block.factor), block.factor)  # the factor is read once
        columns = self.columns(block, products[:, 0])
        smooth = (columns.scaling.unsqueeze(1) * products[:, 1:]).unflatten(1, inner.shape[2:])
        powers = columns.powers_of(self.values(block, columns), smooth)
        ones = torch.ones_like(columns.scaling).unsqueeze(1)
        sums = columns.sums(torch.cat([ones, *powers], dim=1))  # (1, M, 1 + k C)
        coefficients = sums[:, :, 1:].unflatten(2, (len(powers), -1)).transpose(1, 2)
        grams = columns.grams(2) if self.spectral else torch.zeros(1, 1, rows.shape[2], rows.shape[2])
        return columns, (sums[:, :, :1], coefficients, grams)
