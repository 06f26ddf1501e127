"""Tiles of the denoiser."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.nn.denoiser import tiles
from nlfilter_torch.nn.denoiser.noise import noise_map
from nlfilter_torch.nn.denoiser.tiles import in_tiles


def test_tiles_are_as_large_as_the_documentation_says(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, ...]] = []

    def watched(image: Tensor, noise: Tensor) -> Tensor:
        seen.append((len(image), *image.shape[-2:]))
        return noise

    image = torch.zeros(1, 1, 400, 300)
    in_tiles(image, noise_map(0.1, image), watched)
    sides = {side for size in seen for side in size[1:]}
    assert min(sides) >= tiles.SMALLEST
    assert max(sides) == tiles.SIDE
    assert max(size[0] for size in seen) <= tiles.TILE_BATCH
