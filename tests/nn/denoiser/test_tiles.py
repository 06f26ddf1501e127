"""Tiles of the denoiser."""

from threading import get_ident

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalDenoiser
from nlfilter_torch.filtering.noise import noise_map
from nlfilter_torch.nn.denoiser import tiles
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


def test_tiles_in_several_threads_give_the_same_bits_in_any_number() -> None:
    denoiser = NonlocalDenoiser.trained()
    noisy = torch.rand(1, 1, 200, 260, generator=torch.Generator().manual_seed(0))
    before = torch.get_num_threads()
    results = {}
    try:
        with torch.no_grad():
            for threads in (1, 2, 5):
                torch.set_num_threads(threads)
                results[threads] = denoiser(noisy, 0.1)
                assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[1], results[2])
    assert torch.equal(results[1], results[5])


def test_an_error_in_a_tile_is_raised_in_the_calling_thread() -> None:
    def fails(image: Tensor, noise: Tensor) -> Tensor:
        raise ArithmeticError("of a tile")

    image = torch.zeros(1, 1, 400, 300)
    for workers in (1, 3):
        with pytest.raises(ArithmeticError, match="of a tile"):
            in_tiles(image, image, fails, workers=workers)


def test_few_threads_are_used_since_each_needs_memory() -> None:
    seen: set[int] = set()

    def watched(image: Tensor, noise: Tensor) -> Tensor:
        seen.add(get_ident())
        return noise

    image = torch.zeros(1, 1, 900, 900)
    in_tiles(image, image, watched, workers=50)
    assert len(seen) <= tiles.MOST_WORKERS
