"""Values that diffuse from scribbles to neighbouring pixels."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.levin import propagate
from nlfilter_torch.photo import colorize
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import reduced
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.source import luminance
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from nlfilter_torch.photo.selections import local_values
from nlfilter_torch.photo.selections.local_values import ABSOLUTE, RELATIVE, Links, LocalValues
from tests.problems import box, colour
from tests.problems import luminance as grey_of
from tests.streams import stream_colorize
from tests.strokes import SIZE, dots, groups_of


def halves(height: int = 24, width: int = 40) -> Tensor:
    """Dark on the left, bright on the right, with little noise."""
    image = torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(0)) * 0.02 + 0.2
    image[..., width // 2 :] += 0.5
    return image


LINKS = pytest.mark.parametrize("links", [ABSOLUTE, RELATIVE], ids=["absolute", "relative"])


def spread(links: Links, image: Tensor, mask: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean values and influence of a mask."""
    places = mask.flatten().nonzero().squeeze(1)
    return local(links, image, places, mask.flatten(2)[:, :, places], values.flatten(2)[:, :, places])


def local(links: Links, image: Tensor, places: Tensor, weights: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean values and influence of scribbled pixels."""
    size = (image.shape[2], image.shape[3])
    guide = reduced(InMemory(image), luminance, links.step(size))
    solution = LocalValues.of(links, guide, size, places, weights, values)(image, 0)
    return solution[:, :-1], solution[:, -1:]


@LINKS
def test_values_stay_on_their_side_of_a_border(links: Links) -> None:
    image, mask = halves(), box(8, 4, 4, 4, size=(24, 40)) + box(8, 30, 4, 4, size=(24, 40))
    values = torch.full((1, 2, 24, 40), -1.0)
    values[..., 20:] = 1.0
    mean, influence = spread(links, image, mask, values)
    assert mean[..., :19].max() < -0.9
    assert mean[..., 21:].min() > 0.9
    assert influence[mask > 0].min() > 0.99
    assert 0 < influence.min() <= influence.max() <= 1 + 1e-6


@LINKS
def test_a_constant_stays_one(links: Links) -> None:
    mask = box(8, 4, 4, 4, size=(24, 40))
    mean, _ = spread(links, halves(), mask, torch.full((1, 1, 24, 40), 0.3))
    torch.testing.assert_close(mean, torch.full_like(mean, 0.3))


def test_influence_ends_at_a_border_and_falls_with_distance() -> None:
    mask = box(8, 4, 4, 4, size=(24, 40))
    _, influence = spread(ABSOLUTE, halves(), mask, torch.ones(1, 1, 24, 40))
    assert influence[..., 21:].max() < 0.5 * influence[..., :19].min()
    assert (influence[..., 10, 8:19].diff() < 0).all()


def test_relative_links_are_those_of_levin_lischinski_and_weiss() -> None:
    image = colour("chelsea", 24, 30).mean(1, keepdim=True)
    mask = box(4, 6, 3, 3, size=(24, 30)) + box(15, 20, 3, 3, size=(24, 30))
    values = torch.rand(1, 2, 24, 30, generator=torch.Generator().manual_seed(0)) * mask
    solution, _ = spread(RELATIVE, image, mask, values)
    wanted = propagate(image[0, 0].double().numpy(), values[0].double().numpy(), mask[0, 0].numpy() > 0)
    inner = solution[0, :, 1:-1, 1:-1].double().numpy() - wanted[:, 1:-1, 1:-1]
    assert np.abs(inner).max() < 0.008


@LINKS
@pytest.mark.parametrize("pixels", [1 << 16, 8])
def test_gradients(links: Links, pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    image, values, weights = (torch.rand(1, c, 5, 6, generator=generator, dtype=torch.float64) for c in (1, 2, 1))
    places = torch.tensor([3, 7, 20, 29])
    # Finite differences of fixed values would be lost in rounding.
    monkeypatch.setattr(local_values, "SCRIBBLE_WEIGHT", 2.0)
    reduced = replace(links, pixels=pixels)

    def solution(image: Tensor, values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        return local(reduced, 0.1 * image, places, weights, values)

    inputs = (image, values.flatten(2)[..., :4], weights.flatten(2)[..., :4])
    assert torch.autograd.gradcheck(solution, tuple(tensor.clone().requires_grad_() for tensor in inputs), atol=1e-6)


@LINKS
def test_pictures_of_one_pixel_and_of_one_row(links: Links) -> None:
    for size in ((1, 1), (1, 6), (5, 1)):
        mask = box(0, 0, 1, 1, size=size)
        mean, influence = spread(links, torch.full((1, 1, *size), 0.4), mask, torch.full((1, 1, *size), 0.7))
        assert influence.isfinite().all()
        torch.testing.assert_close(mean, torch.full_like(mean, 0.7))


@pytest.mark.parametrize("step", [1, 3, 7])
def test_blocks_of_tiles_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 500)
    picture = np.random.default_rng(0).random((83, 61, 3), np.float32)
    tiled = Tiled(Picture(picture), Passes("float32"))
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    whole = reduced(InMemory(image), luminance, step)
    torch.testing.assert_close(reduced(tiled, luminance, step), whole, atol=1e-7, rtol=0)
    turned = reduced(InMemory(image.flip(2).mT), luminance, step)
    torch.testing.assert_close(turned, whole.flip(2).mT, atol=1e-7, rtol=0)


@pytest.mark.parametrize("rows", [1, 11, 90])
def test_reduced_pictures_are_coloured_in_tiles_as_in_memory(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    for name in ("ABSOLUTE", "RELATIVE"):
        monkeypatch.setattr(
            f"nlfilter_torch.photo.edits.colorize.{name}", replace(getattr(local_values, name), pixels=600)
        )
    image = colour("coffee", 60, 90).double()
    mask = (box(10, 10, 5, 5, size=(60, 90)) + box(40, 60, 5, 5, size=(60, 90))).double()
    options: dict[str, Any] = {"num_landmarks": 30}
    whole = colorize(grey_of(image), image * mask, mask, **options)
    edited = np.empty((60, 90, 3))
    arrays = [tensor[0].permute(1, 2, 0).numpy() for tensor in (grey_of(image), image * mask, mask)]
    stream_colorize(arrays[0], edited, *arrays[1:], statistics="full", tile_rows=rows, memory=1 << 27, **options)
    assert np.abs(edited - whole[0].permute(1, 2, 0).numpy()).max() < 1e-7


@LINKS
def test_a_reduced_picture_gives_nearly_the_same_values(links: Links) -> None:
    image, mask = halves(48, 80), box(16, 8, 8, 8, size=(48, 80)) + box(16, 60, 8, 8, size=(48, 80))
    values = torch.full((1, 1, 48, 80), -1.0)
    values[..., 40:] = 1.0
    exact, reduced = (spread(replace(links, pixels=pixels), image, mask, values) for pixels in (1 << 16, 48 * 80 // 9))
    assert (exact[0] - reduced[0]).abs()[..., [*range(38), *range(42, 80)]].max() < 0.1
    assert (exact[1] - reduced[1]).abs().mean() < 0.1


@pytest.mark.parametrize("links", [ABSOLUTE, RELATIVE], ids=["absolute", "relative"])
def test_neighbours_predict_a_dot_as_if_it_were_not_painted(links: Links) -> None:
    image = torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(1)) * 0.02 + 0.3
    mask = dots((3, 4), (10, 25), (16, 12), (5, 17))
    values = torch.rand(1, 2, *SIZE, generator=torch.Generator().manual_seed(2))
    groups, places = groups_of(mask)
    weights, known = torch.ones(1, 1, 4), values.flatten(2)[:, :, places]
    solution = LocalValues.of(links, image, SIZE, places, weights, known, groups, known)
    assert solution.left_out is not None
    ratio = solution.left_out[:, :-1] / solution.left_out[:, -1:]
    for k in range(4):
        rest = torch.arange(4) != k
        without = LocalValues.of(links, image, SIZE, places[rest], weights[..., rest], known[..., rest])
        wanted = without(image, 0)[:, :-1].flatten(2)[:, :, places[k]]
        torch.testing.assert_close(ratio[:, :, k].float(), wanted, rtol=1e-4, atol=1e-5)
