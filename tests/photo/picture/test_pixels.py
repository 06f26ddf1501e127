"""Sets of pixels of a picture, and edits as functions of them."""

import pytest
import torch

from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.pixels import Fitted, strips_of


def test_pictures_are_divided_if_they_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.rand(1, 3, 40, 50)
    source = InMemory(image)
    assert strips_of(source) == [source]
    monkeypatch.setattr("nlfilter_torch.photo.picture.pixels.STRIP", 300 // torch.get_num_threads())
    parts = strips_of(source)
    assert torch.equal(torch.cat([part.image for part in parts], dim=2), image)
    assert [(part.first, part.width) for part in parts] == [(300 * i, 50) for i in range(7)]
    assert torch.equal(
        source.mean_of(Fitted(lambda part: part.image), torch.mul), image.square().mean((2, 3), keepdim=True)
    )
