"""Measurements of whole pictures: the same in memory and in tiles, in proportion to the opacity of pixels."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch.photo.picture.in_memory import InMemory, in_blocks
from nlfilter_torch.photo.picture.measuring import (
    cached,
    check_in_memory,
    ends,
    everywhere,
    mean,
    mean_of,
    reduced,
    shrunk,
)
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.pixels import Fitted, Pixels, whole_image
from nlfilter_torch.photo.picture.source import at
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from tests.problems import noise

SIZE = (83, 61)


def squares(pixels: Pixels) -> Tensor:
    return pixels.image.square()


def sources(*, opaque: bool = True, memory: int = 1 << 30) -> tuple[InMemory, Tiled]:
    """A picture in memory and in tiles."""
    rows = np.random.default_rng(0).random((*SIZE, 4), np.float32)
    rows[..., 3] = 1 if opaque else rows[..., 3].clip(0.01)
    planes = torch.from_numpy(rows).permute(2, 0, 1)[None]
    return InMemory(planes[:, :3], weights=planes[:, 3:]), Tiled(Picture(rows), Passes("float32", memory=memory))


@pytest.fixture(autouse=True)
def many_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 500)


def test_statistics_are_over_all_pixels_of_every_image() -> None:
    image = noise(2, 3, 12, 15)
    source = InMemory(image)
    assert (source.batch, source.channels, source.size, source.width) == (2, 3, (12, 15), 15)
    torch.testing.assert_close(mean(source, whole_image), image.mean((2, 3), keepdim=True))
    least, most = ends(source, whole_image)
    assert torch.equal(least, image.amin((2, 3), keepdim=True))
    assert torch.equal(most, image.amax((2, 3), keepdim=True))
    assert reduced(source, whole_image, 4).shape == (2, 3, 3, 4)
    torch.testing.assert_close(reduced(source, whole_image, 3)[..., 0, 0], image[..., :3, :3].mean((2, 3)))
    assert source.measured(lambda picture: mean(picture, whole_image)).shape == (2, 3, 1, 1)
    colours, weights = at(source, torch.tensor([3, 20]))
    assert torch.equal(colours, image.flatten(2)[:, :, [3, 20]])
    assert weights is None


@pytest.mark.parametrize("opaque", [True, False])
@pytest.mark.parametrize(
    "measure",
    [
        lambda source: mean(source, squares),
        lambda source: mean_of(source, Fitted(squares), torch.mul),
        lambda source: torch.cat(ends(source, squares)),
        lambda source: at(source, torch.tensor([0, 7, 8, 3000, 83 * 61 - 1]))[0],
        lambda source: everywhere(source, Fitted(squares)),
        lambda source: shrunk(source, squares, (20, 17)),
        lambda source: shrunk(source, squares, (100, 17)),
        lambda source: reduced(source, squares, 1),
        lambda source: reduced(source, squares, 7),
        lambda source: in_blocks(source, 4, 1).image,
    ],
    ids=["mean", "mean_of", "ends", "at", "everywhere", "shrunk", "enlarged", "pixels", "reduced", "in_blocks"],
)
def test_tiles_are_measured_as_a_whole(measure: Callable[[InMemory | Tiled], Tensor], opaque: bool) -> None:
    whole, tiled = map(measure, sources(opaque=opaque))
    torch.testing.assert_close(tiled, whole, atol=1e-6, rtol=0)


def test_gradients_pass_in_memory() -> None:
    image = noise(1, 3, 12, 15).requires_grad_()
    source = InMemory(image)
    total = mean(source, squares).sum() + shrunk(source, squares, (4, 5)).sum() + reduced(source, squares, 5).sum()
    (total + ends(source, squares)[1].sum()).backward()
    assert image.grad is not None
    assert bool((image.grad > 0).any())


def test_results_that_do_not_fit_are_computed_on_every_use() -> None:
    fitted = Fitted(squares)
    for source in sources():
        assert cached(source, fitted) is not fitted
    (_, tiled) = sources(memory=100_000)
    assert cached(tiled, fitted) is fitted


def test_pictures_in_tiles_that_would_have_to_be_in_memory() -> None:
    whole, tiled = sources(memory=100_000)
    check_in_memory(whole, "edit it in memory")
    with pytest.raises(ValueError, match="edit it in memory"):
        check_in_memory(tiled, "edit it in memory")
    in_blocks(whole, 4, 1000)
    with pytest.raises(MemoryError, match="source needs at least 1 MB of memory, but only 0 MB may"):
        in_blocks(tiled, 4, 1000)
