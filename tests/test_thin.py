"""Products with few rows equal plain matrix products, whether divided into parts or not."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import SWEPT
from nlfilter_torch.core.kernels.tall_skinny import gather, moment, spread


def random(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture(params=[1, 2, 3], autouse=True)
def threads(request: pytest.FixtureRequest):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("pixels", [1, 7, 64, SWEPT, 2 * SWEPT + 5])
@pytest.mark.parametrize("rows", [1, 3, 5, 30])
@pytest.mark.parametrize("batch", [1, 2])
def test_equal_to_matrix_products(pixels: int, rows: int, batch: int):
    factor, vectors, images = random(batch, 6, pixels), random(batch, rows, 6), random(batch, rows, pixels)
    gathered = images @ factor.mT
    torch.testing.assert_close(spread(vectors, factor), vectors @ factor)
    scaling = random(batch, pixels)
    torch.testing.assert_close(spread(vectors, factor, scaling), vectors @ factor * scaling.unsqueeze(1))
    torch.testing.assert_close(gather(images, factor), gathered)
    torch.testing.assert_close(moment(factor, images), gathered.mT)


def test_factors_of_any_layout():
    factor, vectors, images = random(1, 64, 6).mT, random(1, 6, 2).mT, random(1, 64, 2).mT
    torch.testing.assert_close(spread(vectors, factor), vectors @ factor)
    torch.testing.assert_close(gather(images, factor), images @ factor.mT)


def test_derivatives_of_any_order():
    leaves = [part.requires_grad_() for part in (random(1, 2, 3), random(1, 3, 8), random(1, 2, 8))]
    torch.autograd.gradgradcheck(lambda rows, factor, _: spread(rows, factor), leaves)
    torch.autograd.gradgradcheck(lambda _, factor, images: gather(images, factor), leaves)
