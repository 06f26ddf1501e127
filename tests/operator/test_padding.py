"""Batches of images of different sizes."""

import torch

from nlfilter_torch import NonlocalFilter, pad_images
from tests.problems import noise


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
