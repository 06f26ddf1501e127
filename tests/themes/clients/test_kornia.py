"""The layer inside the containers of kornia, as kornia's own operations are used there."""

import kornia.augmentation as K
import pytest
import torch
from torch import nn

from nlfilter_torch import NonlocalFilter
from tests.layers import ALPHA, OPTIONS, image


def layer() -> NonlocalFilter:
    return NonlocalFilter(ALPHA, **OPTIONS)


def test_one_image_without_a_batch_is_a_batch_of_one() -> None:
    picture, guide, mask = image(batch=1), image(1, 1), image(2, 1)[:, :1].clamp(0, 1)
    sliders = image(3, 1)[:, :1].repeat(1, 4, 1, 1)
    whole = layer()(picture, guide, mask, sliders)
    torch.testing.assert_close(layer()(picture[0], guide[0], mask[0], sliders[0]), whole[0], atol=0, rtol=0)
    torch.testing.assert_close(layer()(picture[0], guide), layer()(picture, guide)[0], atol=0, rtol=0)
    torch.testing.assert_close(layer()(picture[0]), layer()(picture)[0], atol=0, rtol=0)


@pytest.mark.client("kornia's containers", "`(B, C, H, W)` and `(C, H, W)`")
@pytest.mark.parametrize("batched", [True, False])
def test_containers_run_the_layer(batched: bool) -> None:
    picture = image(batch=1) if batched else image(batch=1)[0]
    expected = layer()(picture)
    for container in (
        nn.Sequential(layer()),
        K.ImageSequential(layer()),
        K.AugmentationSequential(layer(), data_keys=["input"]),
    ):
        torch.testing.assert_close(container(picture).reshape(expected.shape), expected, atol=0, rtol=0)


def test_between_augmentations_the_layer_filters_what_the_first_returns() -> None:
    picture = image()
    container = K.ImageSequential(K.RandomHorizontalFlip(p=1.0), layer(), K.RandomVerticalFlip(p=1.0))
    torch.testing.assert_close(container(picture), layer()(picture.flip(3)).flip(2), atol=0, rtol=0)


def test_dimensions_too_few_or_too_many_are_told() -> None:
    for shape in ((12, 13), (1, 1, 1, 3, 12, 13)):
        with pytest.raises(ValueError, match=r"^image must have shape \(B, C, H, W\) or \(B, C, D, H, W\), got "):
            layer()(torch.zeros(shape))
