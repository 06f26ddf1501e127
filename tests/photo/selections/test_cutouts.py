"""Cut-outs: colours of objects behind soft borders, in memory and in tiles, of large pictures, and gradients."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch.photo import cutout
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import range_of
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.pixels import part_of
from nlfilter_torch.photo.picture.source import Fitted
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from nlfilter_torch.photo.selections import cutouts
from nlfilter_torch.photo.selections.cutouts import Cutout, explained
from tests.problems import colour, noise

SIZE = (60, 72)


def composite(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """An object of a photograph before another, its mask with wide soft borders, and its colours."""
    front, back = (F.interpolate(colour(name, 12, 15), size=SIZE, mode="bicubic") for name in ("coffee", "astronaut"))
    mask = F.interpolate(noise(1, 1, 5, 6, seed=seed, dtype=torch.float32), size=SIZE, mode="bicubic")
    mask = (4 * mask - 1.5).clamp(0, 1)
    return mask * front + (1 - mask) * back, mask, front


@pytest.mark.parametrize("seed", range(3))
def test_colours_of_the_object_come_back_behind_soft_borders(seed: int) -> None:
    image, mask, front = composite(seed)
    cut = cutout(image, mask)
    assert cut.shape == (1, 4, *SIZE)
    assert torch.equal(cut[:, 3:], mask)
    soft = ((mask > 0.02) & (mask < 0.98)).float()
    found, before = ((mask * (colours - front)).square() * soft for colours in (cut[:, :3], image))
    assert found.sum() < before.sum() / 2
    solid = (mask == 1).expand(-1, 3, -1, -1)
    torch.testing.assert_close(cut[:, :3][solid], image[solid], atol=1e-6, rtol=0)


def test_a_picture_larger_than_the_viewing_size_and_tiles_are_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    image, mask, front = composite()
    whole = cutout(image, mask)
    monkeypatch.setattr(cutouts, "VIEWING", 60 * 72 / 4e6)
    large = cutout(image, mask)
    errors = [(mask * (cut[:, :3] - front)).square().mean() for cut in (whole, large, image)]
    assert errors[0] < errors[2] / 2
    assert errors[1] < errors[2] / 1.5
    rows = image[0].permute(1, 2, 0).numpy()
    tiled = Tiled(Picture(rows), Passes("float32", "full", tile_rows=16))
    fitted = Fitted(Cutout.of(tiled, part_of(mask)))
    with tiled.tiling(fitted, plain=True) as tiling:
        parts = np.concatenate([values for _, values in tiling])
    np.testing.assert_allclose(parts, large[0].permute(1, 2, 0).numpy(), atol=1e-5)


def test_grey_pictures_batches_and_precision() -> None:
    image, mask, _ = composite()
    grey = image.mean(1, keepdim=True)
    cut = cutout(grey, mask)
    assert torch.equal(cut[:, 0], cut[:, 2])
    both = cutout(torch.cat([image, image.flip(3)]).double(), torch.cat([mask, mask.flip(3)]))
    assert both.dtype == torch.float64
    torch.testing.assert_close(both[:1].float(), cutout(image, mask), atol=1e-4, rtol=0)
    for size in ((1, 1), (1, 7), (3, 2)):
        pixels = noise(1, 3, *size, dtype=torch.float32)
        assert torch.isfinite(cutout(pixels, pixels[:, :1])).all()
        torch.testing.assert_close(cutout(pixels, torch.ones_like(pixels[:, :1]))[:, :3], pixels)


def test_values_of_another_range_are_seen_in_it() -> None:
    image, mask, _ = composite()
    faint = InMemory(0.02 * image)
    working = range_of(faint)
    seen = faint.in_range(working)
    colours = faint.all(Fitted(Cutout.of(seen, part_of(mask), working), working=working, gives_picture=False))
    torch.testing.assert_close(50 * colours[:, :3], cutout(image, mask)[:, :3], atol=2e-3, rtol=0)


def test_gradients() -> None:
    image, mask = (t[..., 20:25, 20:26].double() for t in composite()[:2])
    inner = 0.1 + 0.8 * mask
    inputs = [t.requires_grad_() for t in (0.1 + 0.8 * image, inner)]
    assert torch.autograd.gradcheck(cutout, inputs, atol=1e-4)


def test_given_colours_move_to_explain_a_pixel() -> None:
    image, mask = noise(1, 3, 4, 5), noise(1, 1, 4, 5, seed=1)
    front, back = noise(1, 3, 4, 5, seed=2), noise(1, 3, 4, 5, seed=3)
    found = explained(image, mask, front, back)
    torch.testing.assert_close(mask * found[0] + (1 - mask) * found[1], image)
    weight = torch.tensor(0.3, dtype=torch.float64)
    near = explained(image, mask, front, back, weight)
    for k, share in enumerate((mask, 1 - mask)):  # the derivatives of what is minimised are 0
        left = mask * near[0] + (1 - mask) * near[1] - image
        slope = share * left + weight * (near[k] - (front, back)[k])
        torch.testing.assert_close(slope, torch.zeros_like(slope), atol=1e-12, rtol=0)
