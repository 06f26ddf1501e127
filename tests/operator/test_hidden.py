"""Filling hidden pixels: a rectangle that counts is continued as an image of that size is padded."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalFilter, pad_images
from nlfilter_torch.operator.features import pad_border
from nlfilter_torch.operator.hidden import MIRRORED, NEAR, REACH, fill_hidden, fill_nearby
from tests.problems import noise


@pytest.mark.parametrize("shape", [(7, 9), (7, 2), (1, 1), (3, 8)])
def test_a_rectangle_is_continued_as_an_image_is_padded(shape: tuple[int, int]) -> None:
    for margin in [0, 1, 2, 3]:
        image = noise(2, 3, *shape)
        canvas, counts = torch.full((2, 3, 12, 14), torch.nan), torch.zeros(2, 1, 12, 14)
        canvas = canvas.double()
        canvas[..., : shape[0], : shape[1]] = image
        counts[..., : shape[0], : shape[1]] = 1
        filled = fill_hidden(canvas, counts > 0, margin)
        assert filled.shape == (2, 3, 12 + 2 * margin, 14 + 2 * margin)
        expected = pad_border(image, margin)
        torch.testing.assert_close(filled[..., : expected.shape[2], : expected.shape[3]], expected, atol=1e-14, rtol=0)


def test_replication_and_volumes() -> None:
    volume = noise(1, 1, 3, 4, 5)
    counts = torch.ones_like(volume) > 0
    expected = torch.nn.functional.pad(volume, (1,) * 6, mode="replicate")
    torch.testing.assert_close(fill_hidden(volume, counts, 1, mirrored=False), expected, atol=1e-14, rtol=0)
    expected = torch.nn.functional.pad(volume, (2,) * 6, mode="reflect")
    torch.testing.assert_close(fill_hidden(volume, counts, 2), expected, atol=1e-14, rtol=0)


def test_a_hole_lies_between_what_surrounds_it() -> None:
    ramp = torch.arange(9.0).expand(1, 1, 9, 9).clone()
    counts = torch.ones_like(ramp)
    counts[..., 3:6, 3:6] = 0
    filled = fill_hidden(ramp * counts, counts > 0, 0)
    assert torch.equal(filled[counts > 0], ramp[counts > 0])
    middle = filled[0, 0, 3:6, 3:6]
    assert bool(((middle > 2) & (middle < 6)).all())
    assert bool((middle.diff(dim=1) > 0).all())


@pytest.mark.parametrize("turn", [lambda x: x.flip(2), lambda x: x.flip(3), lambda x: x.mT], ids=["up", "left", "mT"])
def test_no_direction_is_preferred(turn: Callable[[Tensor], Tensor]) -> None:
    image, counts = noise(1, 2, 11, 11), noise(1, 1, 11, 11, seed=1) > 0.7
    torch.testing.assert_close(fill_hidden(turn(image), turn(counts), 2), turn(fill_hidden(image, counts, 2)))


def test_gradcheck_and_hidden_values_have_no_gradient() -> None:
    image, counts = noise(1, 2, 5, 6).requires_grad_(), noise(1, 1, 5, 6, seed=1) > 0.5
    assert torch.autograd.gradcheck(lambda planes: fill_hidden(planes, counts, 2), image)
    (gradient,) = torch.autograd.grad(fill_hidden(image, counts, 2).sum(), image)
    assert not bool(gradient[(~counts).expand_as(gradient)].any())


def test_what_is_near_is_mirrored_and_what_is_far_is_0() -> None:
    image = noise(1, 2, 60, 20)
    canvas, counts = torch.zeros(1, 2, 200, 20).double(), torch.zeros(1, 1, 200, 20)
    canvas[:, :, :60], counts[:, :, :60] = image, 1
    filled = fill_nearby(canvas, counts > 0)
    assert torch.equal(filled[:, :, :60], image)
    expected = torch.cat([image, image[:, :, 59 - MIRRORED : 59].flip(2)], dim=2)
    torch.testing.assert_close(filled[:, :, : 60 + MIRRORED], expected, atol=1e-14, rtol=0)
    assert bool((filled[:, :, 60 + NEAR - 1] != 0).all())
    assert not filled[:, :, 60 + 2 * NEAR :].any()


def test_rows_are_filled_as_in_the_whole_image() -> None:
    image = noise(1, 1, 400, 30)
    counts = torch.rand(1, 1, 400, 30, generator=torch.Generator().manual_seed(0)) > 0.9
    counts[..., 150:300, :] = False
    whole = fill_nearby(image, counts)
    for start, stop in ((0, 20), (170, 200), (290, 310), (390, 400)):
        first, last = max(start - REACH, 0), min(stop + REACH, 400)
        part = fill_nearby(image[:, :, first:last], counts[:, :, first:last])
        assert torch.equal(part[:, :, start - first : stop - first], whole[:, :, start:stop])
    everything = torch.ones_like(counts)
    assert torch.equal(fill_nearby(image, everything), image)
    assert not fill_nearby(image, ~everything).any()


def test_images_lie_at_the_top_left() -> None:
    images = [noise(3, 5, 8, seed=1).requires_grad_(), noise(3, 7, 6, seed=2)]
    batch, weights = pad_images(images)
    assert batch.shape == (2, 3, 7, 8)
    assert weights.shape == (2, 1, 7, 8)
    assert weights.dtype == batch.dtype == torch.float64
    for image, canvas, row in zip(images, batch, weights, strict=True):
        inside = (slice(None), slice(image.shape[1]), slice(image.shape[2]))
        assert torch.equal(canvas[inside], image)
        assert canvas.count_nonzero() == image.numel()
        assert row.sum() == row[inside].sum() == image[0].numel()
    batch.sum().backward()
    assert torch.equal(images[0].grad, torch.ones(3, 5, 8))


def test_volumes_and_one_image() -> None:
    batch, weights = pad_images([noise(1, 3, 4, 5), noise(1, 2, 6, 5)])
    assert batch.shape == weights.shape == (2, 1, 3, 6, 5)
    assert pad_images([noise(2, 4, 5)])[1].all()


def test_a_layer_filters_each_as_if_alone() -> None:
    images, layer = [noise(3, 20, 30, seed=1), noise(3, 26, 18, seed=2)], NonlocalFilter((3, 2, 1.05), num_landmarks=40)
    batch, weights = pad_images(images)
    for image, result in zip(images, layer(batch, weights=weights), strict=True):
        torch.testing.assert_close(result[:, : image.shape[1], : image.shape[2]], layer(image), atol=1e-9, rtol=0)
