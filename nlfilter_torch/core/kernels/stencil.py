"""Linear systems in which the equation of each pixel contains the pixel and its eight neighbours.

They are solved in float64. The kernel in C eliminates the pixels by nested dissection, with about 50 N^1.5 operations
for N pixels; the definition in torch eliminates them row by row, with about 3 N^2.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.kernels.library import kernel, pointer, run, threads
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.torch_internals import register


@full_precision
def solve_stencil(stencil: Tensor, right: Tensor) -> Tensor:
    """Solve a linear system of pixels and their neighbours.

    The matrix or its transpose should be diagonally dominant, since the kernel in C does not exchange pivots, and the
    definition does so only within a row of the image.

    Args:
        stencil: (B, 3, 3, H, W); coefficient of the neighbour in the previous, same or next row and column. Those of
            neighbours outside the image are ignored. The matrix need not be symmetric.
        right: right sides, (B, C, H, W).

    Returns:
        The solution (B, C, H, W). Differentiable any number of times; each derivative takes one more solution.

    Example:
        >>> stencil = torch.zeros(1, 3, 3, 1, 5)  # every pixel is the mean of its neighbours in the row
        >>> stencil[:, 1, 0] = stencil[:, 1, 2] = -1
        >>> stencil[:, 1, 1] = 2
        >>> right = torch.tensor([0.0, 0, 0, 0, 6]).view(1, 1, 1, 5)  # 0 before the row, 6 after it
        >>> solve_stencil(stencil, right).flatten()
        tensor([1., 2., 3., 4., 5.])
    """
    # torch.compile supports no functions with a jvp.
    function = solve if torch.compiler.is_compiling() else _Solution.apply
    solution: Tensor = function(stencil.double(), right.double())
    return solution.to(right.dtype)


class _Solution(torch.autograd.Function):
    """:func:`solve`, with derivatives by further solutions instead of those of its steps."""

    generate_vmap_rule = True

    @staticmethod
    def forward(stencil: Tensor, right: Tensor) -> Tensor:
        return solve(stencil, right)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)
        ctx.save_for_forward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor]:
        stencil, solution = ctx.saved_tensors
        grad = solve_stencil(_transposed(stencil), grad)
        if not ctx.needs_input_grad[0]:
            return None, grad
        products = torch.stack([(grad * values).sum(1) for values in _around(solution)], dim=1)
        return -products.view(stencil.shape), grad

    @staticmethod
    def jvp(ctx: Any, stencil_tangent: Tensor | None, right_tangent: Tensor | None) -> Tensor:
        stencil, solution = ctx.saved_tensors
        right = torch.zeros_like(solution) if right_tangent is None else right_tangent
        if stencil_tangent is not None:
            for number, values in enumerate(_around(solution)):
                right = right - stencil_tangent[:, number // 3, number % 3, None] * values
        return solve_stencil(stencil, right)


def _around(planes: Tensor) -> list[Tensor]:
    """Values (B, C, H, W) of each pixel's nine neighbours, with the pixel itself, row by row; 0 outside the image."""
    height, width = planes.shape[2:]
    padded = F.pad(planes, (1, 1, 1, 1))
    return [padded[..., k : k + height, j : j + width] for k in range(3) for j in range(3)]


def _transposed(stencil: Tensor) -> Tensor:
    """Stencil of the transposed matrix: each coefficient is that of the pixel in its neighbour's equation."""
    around = _around(stencil.flatten(1, 2).flip(1))
    return torch.stack([values[:, number] for number, values in enumerate(around)], dim=1).unflatten(1, (3, 3))


def _compiled_solve(stencil: Tensor, right: Tensor) -> Tensor:
    stencil, right = stencil.contiguous(), right.contiguous()
    out = torch.empty_like(right)
    _, sides, height, width = right.shape
    run("stencil", threads(stencil), len(right), height, width, sides, *map(pointer, (stencil, right, out)))
    return out


@register(
    "solve(Tensor stencil, Tensor right) -> Tensor",
    kernel(_compiled_solve, torch.float64),
    lambda stencil, right: torch.empty_like(right),
    differentiable=True,
)
def solve(stencil: Tensor, right: Tensor) -> Tensor:
    """:func:`solve_stencil` in float64.

    The matrix is block tridiagonal, with a block for each row of pixels (or each column, if these are shorter), and is
    eliminated block by block: an image of h x w pixels, h <= w, takes about 3 h^3 w operations.
    """
    if right.shape[3] > right.shape[2]:
        return _by_rows(stencil.transpose(1, 2).mT, right.mT).mT.contiguous()
    return _by_rows(stencil, right)


def _by_rows(stencil: Tensor, right: Tensor) -> Tensor:
    width = right.shape[3]
    # Matrices are stored transposed, since LAPACK expects columns to be contiguous.
    rows: list[Tensor] = []  # of each row of pixels: matrix for the next row and constant, (B, W+C, W)
    stencils = stencil.permute(3, 1, 0, 2, 4)  # (H, 3, B, 3, W)
    padded = F.pad(stencils, (1, 1))
    turned = torch.stack([padded[..., 2, :-2], stencils[..., 1, :], padded[..., 0, 2:]], dim=-1)  # (H, 3, B, W, 3)
    for bands, columns, constant in zip(stencils, turned, right.permute(2, 0, 1, 3), strict=True):
        own, after = _tridiagonal(columns[1]), _tridiagonal(columns[2])
        if rows:
            eliminated = _tridiagonal_product(bands[0], rows[-1])
            own, constant = own + eliminated[:, :width], constant - eliminated[:, width:]
        rows.append(torch.linalg.solve(own.mT, torch.cat([-after, constant], dim=1).mT).mT)
    solved = [rows.pop()[:, width:]]
    for row in reversed(rows):
        solved.append(torch.baddbmm(row[:, width:], solved[-1], row[:, :width]))
    return torch.stack(solved[::-1], dim=2)


def _tridiagonal(bands: Tensor) -> Tensor:
    """Matrices (B, N, N) with the rows' entries (B, N, 3) on and beside the diagonal."""
    count = bands.shape[1]
    # Rows of N + 3 entries, read as rows of N + 2, move to the right by one from row to row.
    entries = F.pad(bands, (0, count)).flatten(1)[:, : count * (count + 2)]
    return entries.unflatten(1, (count, count + 2))[..., 1:-1]


def _tridiagonal_product(bands: Tensor, transposed: Tensor) -> Tensor:
    """Transposed product of tridiagonal matrices and matrices, of which the second are given transposed, (B, K, N).

    ``bands`` (B, 3, N) has the entries before, on and after the diagonal in each row.
    """
    before, own, after = bands.split(1, dim=1)  # (B, 1, N)
    padded = F.pad(transposed, (1, 1))
    return torch.addcmul(torch.addcmul(own * transposed, before, padded[..., :-2]), after, padded[..., 2:])
