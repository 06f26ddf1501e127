"""Sets of pixels of a picture, and edits as functions of them."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import mean_of
from nlfilter_torch.photo.picture.pixels import Fitted, Pixels, Strip, corner, part_of, strips_of, whole_image
from tests.problems import noise


def test_pictures_are_divided_if_they_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.rand(1, 3, 40, 50)
    source = InMemory(image)
    assert strips_of(source) == [source]
    monkeypatch.setattr("nlfilter_torch.photo.picture.pixels.STRIP", 300 // torch.get_num_threads())
    parts = strips_of(source)
    assert torch.equal(torch.cat([part.image for part in parts], dim=2), image)
    assert [(part.first, part.width) for part in parts] == [(300 * i, 50) for i in range(7)]
    squares = mean_of(source, Fitted(lambda part: part.image), torch.mul)
    torch.testing.assert_close(squares, image.square().mean((2, 3), keepdim=True), atol=1e-7, rtol=0)


def test_a_part_of_planes_is_at_the_same_place_as_the_pixels() -> None:
    planes = noise(2, 4, 9, 11)
    image = planes[:, :3]
    assert corner(InMemory(image)) == (0, 0)
    assert torch.equal(part_of(planes)(InMemory(image)), planes)
    strip = Strip(image[:, :, 2:5], 2 * 11, 11)
    assert corner(strip) == (2, 0)
    assert torch.equal(part_of(planes)(strip), planes[:, :, 2:5])
    rectangle = Strip(image[:, :, 2:5, 3:7], 2 * 11 + 3, 11)
    assert corner(rectangle) == (2, 3)
    assert torch.equal(part_of(planes)(rectangle), planes[:, :, 2:5, 3:7])
    assert whole_image(strip) is strip.image


def squares(pixels: Pixels) -> Tensor:
    return pixels.image.square()


def blurred(image: Tensor, planes: Tensor, inner: Inner) -> Tensor:
    return torch.nn.functional.avg_pool2d(planes, 3, 1, 1) + image


def test_a_pointwise_function_can_follow_an_edit() -> None:
    image = noise(1, 3, 8, 9)
    pointwise = Fitted(squares).then(torch.sub)
    assert torch.equal(InMemory(image).all(pointwise), image - image.square())
    assert (pointwise.finish, pointwise.margin) == (None, 0)
    edit = Fitted(squares, blurred, margin=1, step=2)
    followed = edit.then(torch.mul)
    assert (followed.margin, followed.step) == (1, 2)
    assert torch.equal(InMemory(image).all(followed), image * InMemory(image).all(edit))


def test_a_picture_that_is_compiled_is_not_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    source = InMemory(noise(1, 3, 40, 50))
    monkeypatch.setattr("nlfilter_torch.photo.picture.pixels.STRIP", 300)
    assert len(strips_of(source)) > 1
    monkeypatch.setattr("torch.compiler.is_compiling", lambda: True)
    assert strips_of(source) == [source]
