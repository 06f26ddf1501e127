"""Columns of the Nystrom factor and their gradients: the kernel in C agrees with the definition in torch."""

from typing import Any

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import OuterProduct
from nlfilter_torch.operator.nystrom import inverse_cholesky, nystrom_factor
from tests.native import LEVELS, by_torch, random
from tests.pairwise import pairwise
from tests.rounding import SPREAD


@pytest.mark.parametrize(
    ("level", "completion", "pixels", "size_and_marks"),
    pairwise(
        LEVELS,
        ["diagonal", "none"],
        [1, 7, 31, 64, 65, 1000, 8256, 20_011],
        [(1, 1), (9, 2), (25, 5), (27, 6), (3, 100)],
    ),
    indirect=["level"],
)
def test_columns(level: int, completion: Any, pixels: int, size_and_marks: tuple[int, int]) -> None:
    size, marks = size_and_marks
    z = random(2, size, marks, seed=1)
    x = random(2, size, pixels) * 0.7
    x[:, :, : min(pixels, marks)] = z[:, :, : min(pixels, marks)]  # columns that rounding may make longer than 1
    arguments = (x, z, inverse_cholesky(z), completion)
    result = nystrom_factor(*arguments)
    expected = nystrom_factor(*(part.double() for part in arguments[:3]), completion)
    plain = by_torch(nystrom_factor, *arguments)
    for native_part, torch_part, exact in zip(result, plain, expected, strict=True):
        error, usual = (native_part - exact).abs().max(), (torch_part - exact).abs().max()
        assert error <= SPREAD * usual + 2e-6, (error, usual)
    assert (result[0].square().sum(1) <= 1 + 1e-5).all() or completion == "none"


def test_columns_of_a_whitening_without_a_triangle(level: int) -> None:
    x, z, whitening = random(1, 4, 500), random(1, 4, 11, seed=1), random(1, 11, 11, seed=2) / 20
    expected = nystrom_factor(x.double(), z.double(), whitening.double(), "none")[0]
    torch.testing.assert_close(nystrom_factor(x, z, whitening, "none")[0], expected.float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("level", "completion", "pixels", "size_and_marks", "rank"),
    pairwise(LEVELS, ["diagonal", "none"], [1, 65, 2100], [(1, 1), (9, 2), (27, 6), (3, 100), (6, 150)], [None, 9]),
    indirect=["level"],
)
def test_derivatives_of_columns(
    level: int, completion: Any, pixels: int, size_and_marks: tuple[int, int], rank: int | None
) -> None:
    size, marks = size_and_marks
    z = random(2, size, marks, seed=1)
    x = random(2, size, pixels) * 0.7
    x[:, :, : min(pixels, marks)] = z[:, :, : min(pixels, marks)]  # columns that rounding may make longer than 1
    along = random(2, marks, rank or pixels, seed=2)
    if rank is not None:  # a gradient that is not formed
        along = OuterProduct(along, random(2, rank, pixels, seed=3))
    slopes = along, random(2, pixels, seed=4)

    def gradients(dtype: torch.dtype) -> list[Tensor]:
        inputs = [part.to(dtype).requires_grad_() for part in (x, z, inverse_cholesky(z))]
        *result, whitening = torch.autograd.grad(
            nystrom_factor(*inputs, completion), inputs, [slope.to(dtype) for slope in slopes]
        )
        return [*result, whitening.tril()]

    result, plain = gradients(torch.float32), by_torch(gradients, torch.float32)
    exact, size_of_terms = gradients(torch.float64), (inverse_cholesky(z).mT.abs() @ (0 + along).abs()).max()
    for native_part, torch_part, part in zip(result, plain, exact, strict=True):
        error, usual = (native_part - part).abs().max(), (torch_part - part).abs().max()
        assert error <= SPREAD * usual + 1e-6 * size_of_terms, (error, usual)


def test_derivatives_by_any_whitening_and_of_long_columns(level: int) -> None:
    inputs = [random(1, 4, 500), random(1, 4, 11, seed=1), random(1, 11, 11, seed=2)]
    slopes = random(1, 11, 500, seed=3), random(1, 500, seed=4)
    shortened = nystrom_factor(*inputs, "diagonal")[1] == 0
    assert 100 < shortened.sum() < 400
    for completion in ("diagonal", "none"):
        result, exact = (
            torch.autograd.grad(nystrom_factor(*twins, completion), twins, [slope.to(twins[0]) for slope in slopes])
            for twins in ([t.to(dtype).requires_grad_() for t in inputs] for dtype in (torch.float32, torch.float64))
        )
        for gradient, other in zip(result, exact, strict=True):
            torch.testing.assert_close(gradient.double(), other, atol=1e-4, rtol=1e-5)


def test_far_features_meet_the_floor_and_nan_is_not_hidden(level: int) -> None:
    z = random(1, 3, 8)
    x = random(1, 3, 200, seed=1)
    x[:, :, 50] = 1e30  # its squared norm overflows
    x[:, 1, 60] = torch.nan
    factor, diagonal = nystrom_factor(x, z, inverse_cholesky(z), "diagonal")
    assert factor[..., 50].abs().max() < 1e-12
    assert diagonal[0, 50] == 1
    assert factor[..., 60].isnan().all()
    assert diagonal[0, 60].isnan()
    rest = torch.arange(200) != 60
    assert factor[..., rest].isfinite().all()
