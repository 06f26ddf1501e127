"""Limits of brightness, flat areas, and sliders with the same effect at any resolution."""

from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch import adjust_tone, enhance, sharpen
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.changes import limit_by_activity, split_sliders
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import Balance, Limits
from nlfilter_torch.photo.picture.pixels import Fitted, part_of
from nlfilter_torch.photo.picture.resizing import resize, resized
from nlfilter_torch.photo.picture.viewing import viewed_size, within_limits
from nlfilter_torch.photo.tiled import stream_detail
from nlfilter_torch.photo.tiled.pictures import Picture
from nlfilter_torch.photo.tiled.source import Tiled
from nlfilter_torch.photo.tiled.tiles import Passes
from tests.problems import colour, luminance

ALPHA = torch.tensor([2.2, 2.2, 2.2, 1.0])
EDITS: dict[str, Any] = {
    "detail": lambda x, **options: enhance(x, ALPHA, num_landmarks=60, **options),
    "tone": lambda x, **options: adjust_tone(x, contrast=1.5, clarity=2.0, num_landmarks=60, **options),
    "sharpen": lambda x, **options: sharpen(x, amount=8.0, num_landmarks=60, **options),
}


# --- limits


def drawn(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Images of 8 bits with channels at both ends of the range, and large changes of their luminance."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (2, 3, 40, 40), generator=generator).double() / 255
    image[0, 0, :9], image[1, 1, :9] = 0.0, 1.0  # no room in one direction
    return image, torch.randn(2, 1, 40, 40, generator=generator, dtype=torch.float64)


def saturated(seed: int = 0, size: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """A yellow image without blue whose last third is muted, and changes of its luminance."""
    generator = torch.Generator().manual_seed(seed)
    yellow = torch.tensor([0.95, 0.8, 0.01], dtype=torch.float64).view(1, 3, 1, 1)
    image = yellow * (0.95 + 0.1 * torch.rand(1, 3, size, size, generator=generator, dtype=torch.float64))
    muted = slice(2 * size // 3, size)
    image[..., muted] = 0.5 + 0.1 * (image[..., muted] - 0.5)
    return image, 0.15 * torch.randn(1, 1, size, size, generator=generator, dtype=torch.float64)


def changed(
    image: torch.Tensor,
    change: torch.Tensor,
    limits: Limits = "soft",
    brighter: float | Balance | None = None,
) -> torch.Tensor:
    source = InMemory(image)
    return source.all(within_limits(source, Fitted(part_of(change)), limits, brighter))


def test_changes_keep_within_their_room_and_small_ones_are_kept() -> None:
    image, change = drawn()
    for found in (changed(image, change), changed(image, change, brighter=0.0)):
        levels = (255 * found).round()
        assert not bool(((levels <= 0) & (image > 0)).any())  # no channel clips that did not before
        assert not bool(((levels >= 255) & (image < 1)).any())
        assert found.min() >= -1e-12
        assert found.max() <= 1 + 1e-12
    found = changed(image, change)
    moved = luminance(found) - luminance(image)
    assert bool((moved * change >= -1e-12).all())
    assert bool((moved.abs() <= change.abs() + 1e-12).all())
    before, after = (x - luminance(x) for x in (image, found))
    assert bool((torch.linalg.cross(before, after, dim=1).abs() < 1e-7).all())  # hues are kept
    assert bool((after.norm(dim=1) <= before.norm(dim=1) + 1e-6).all())
    middle = torch.full((1, 3, 4, 4), 0.5, dtype=torch.float64)
    torch.testing.assert_close(changed(middle, middle[:, :1] * 0.002), middle + 0.001, atol=2e-6, rtol=0)
    still = torch.zeros_like(change)
    assert torch.equal(changed(image, still), image)
    assert torch.equal(changed(image, still, brighter=0.0), image)
    assert torch.equal(changed(image, change, "none"), image + change)


@pytest.mark.parametrize(("rest", "change"), [((87, 160), -0.055), ((170, 90), 0.05)])
def test_a_channel_near_its_end_causes_no_edge(rest: tuple[int, int], change: float) -> None:
    ends = [5, 4, 3, 2, 1, 0] if change < 0 else [250, 251, 252, 253, 254, 255]
    sky = torch.tensor([[end, *rest] for end in ends]).T.reshape(1, 3, 1, 6) / 255  # a smooth saturated area
    moved = luminance(changed(sky, torch.full((1, 1, 1, 6), change)) - sky).flatten() * 255
    assert moved.abs().min() > 5
    assert moved.diff().abs().max() < 1


@pytest.mark.parametrize("channels", [1, 3])
def test_balance_keeps_mean_brightness_and_chroma(channels: int) -> None:
    image, change = drawn()
    image, change = 0.1 + 0.5 * image[:, :channels], 0.2 * change

    def means(x: torch.Tensor) -> torch.Tensor:
        grey = luminance(x) if channels == 3 else x
        return torch.stack([grey.mean((1, 2, 3)), (x - grey).norm(dim=1).mean((1, 2))])

    alone = means(changed(image, change))
    assert (alone[0] - means(image)[0]).abs().min() > 0.004
    for brighter in (0.0, 0.05):
        found = means(changed(image, change, brighter=brighter))
        torch.testing.assert_close(found[0], (1 + brighter) * means(image)[0], atol=2e-6, rtol=0)
        torch.testing.assert_close(found[1], means(image)[1], atol=2e-6, rtol=0)


def test_saturated_colours_keep_their_chroma_and_muted_ones_their_detail() -> None:
    image, change = saturated()
    before = image - luminance(image)

    def lost(found: torch.Tensor) -> float:
        return 1 - float((found - luminance(found)).norm(dim=1).mean() / before.norm(dim=1).mean())

    assert lost(changed(image, change)) > 0.1
    found = changed(image, change, brighter=0.0)
    assert abs(lost(found)) < 0.015
    assert abs((luminance(found) - luminance(image)).mean()) < 2e-6
    assert bool((torch.linalg.cross(before, found - luminance(found), dim=1).abs() < 1e-7).all())  # hues are kept
    free, full = (changed(image, change, brighter=Balance(torch.tensor(r).double())) for r in (0.0, 1.0))
    assert abs(lost(full)) < 1e-6
    torch.testing.assert_close(full[..., 27:], free[..., 27:], atol=0, rtol=0)
    assert torch.equal(changed(image, change), free)
    both = torch.cat([image, 0.3 + 0.1 * image]), torch.cat([change, change])  # the second needs no restraint
    together = changed(*both, brighter=0.0)
    for i in range(2):
        alone = changed(both[0][i : i + 1], both[1][i : i + 1], brighter=0.0)
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-12, rtol=0)


@pytest.mark.parametrize("restraint", [0.3, 0.7, 1.0])
@pytest.mark.parametrize(("rest", "change"), [((87, 160), -0.055), ((170, 90), 0.05)])
def test_a_restrained_change_causes_no_edge(rest: tuple[int, int], change: float, restraint: float) -> None:
    ends = [9, 8, 7, 6, 5, 4, 3, 2, 1, 0] if change < 0 else [246, 247, 248, 249, 250, 251, 252, 253, 254, 255]
    sky = torch.tensor([[end, *rest] for end in ends]).T.reshape(1, 3, 1, 10) / 255
    balance = Balance(torch.tensor(restraint))
    moved = luminance(changed(sky, torch.full((1, 1, 1, 10), change), brighter=balance) - sky).flatten() * 255
    assert bool((moved * change >= 0).all())
    assert moved.diff().abs().max() < 1.01  # at most as much as the channel


@pytest.mark.parametrize("name", EDITS)
def test_edits_keep_mean_brightness_and_chroma(name: str) -> None:
    image = colour("astronaut", 60, 80)
    for size in (0.0025, 0):
        found = EDITS[name](image, viewing_size=size)
        assert (luminance(found) - luminance(image)).mean().abs() < (1 / 255 if size else 2e-5)
        assert (
            (found - luminance(found)).norm(dim=1).mean() / (image - luminance(image)).norm(dim=1).mean() - 1
        ) < 0.02


def test_limits_have_exact_gradients() -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(1, 3, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    change = torch.randn(1, 1, 4, 5, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(changed, (image, change))
    for tensors in (saturated(size=6), (image.detach(), change.detach())):
        inputs = [tensor.clone().requires_grad_() for tensor in tensors]
        assert torch.autograd.gradcheck(lambda x, d: changed(x, d, brighter=0.0), inputs)
    still = torch.zeros(1, 1, 4, 5, dtype=torch.float64, requires_grad=True)
    changed(image.detach(), still).sum().backward()
    assert still.grad is not None
    torch.testing.assert_close(still.grad, torch.full_like(still, 3.0))  # gradients can move sliders away from 1


@pytest.mark.parametrize("name", EDITS)
def test_soft_limits_do_not_clip_and_none_is_the_plain_sum(name: str) -> None:
    image = colour("astronaut", 48, 64)
    soft, hard = (EDITS[name](image, limits=limits) for limits in ("soft", "none"))
    inside = (image > 0.02) & (image < 0.98)
    assert soft[inside].min() > 0
    assert soft[inside].max() < 1
    assert hard.min() < 0
    assert hard.max() > 1
    chroma = [x - luminance(x) for x in (hard, image)]
    torch.testing.assert_close(chroma[0], chroma[1], atol=1e-5, rtol=0)  # the change is the same in all channels
    change = luminance(hard) - luminance(image)
    limited = changed(image, change, brighter=0.0)
    torch.testing.assert_close(limited, soft, atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="limits must be one of 'soft', 'none', got 'hard'"):
        EDITS[name](image, limits="hard")


@pytest.mark.parametrize("channels", [1, 3])
def test_values_above_white_change_as_little_as_asked(channels: int) -> None:
    """As in float files; the tone curve that keeps the mean brightness has no meaning there."""
    image, change = drawn()
    image, change = 4 * image[:, :channels], 1e-4 * change.clamp(-2, 2)
    assert (changed(image, change, brighter=0.0) - image).abs().max() < 0.01


@pytest.mark.parametrize("residual", [None, 1.0])
def test_sliders_at_1_change_no_bit(residual: float | None) -> None:
    image, region = colour("coffee", 40, 60), torch.zeros(1, 1, 40, 60)
    region[..., 10:20, 10:20] = 1
    for options in ({}, {"viewing_size": 0.001}, {"limits": "none"}, {"threshold": 0.0}):
        found = enhance(image, torch.ones(4), residual=residual, num_landmarks=40, **options)
        assert torch.equal(found, image)
        found = enhance(image, torch.ones(4), region, outside=torch.ones(4), num_landmarks=40, **options)
        assert torch.equal(found, image)


# --- flat areas


def test_calm_areas_are_strengthened_less_and_smoothed_alike() -> None:
    changes = torch.tensor([0.4, 0.1]).view(1, 2, 1, 1).expand(1, 2, 1, 3)
    variance = torch.tensor([0.0, 1e-4, 1.0]).view(1, 1, 1, 3)
    found = limit_by_activity(changes, variance, 0.01).flatten()
    torch.testing.assert_close(found, torch.tensor([0.1, 0.3, 0.5]), atol=1e-4, rtol=0)
    assert torch.equal(limit_by_activity(changes, variance, 0.0), torch.full((1, 1, 1, 3), 0.5))
    added, rest = split_sliders(torch.tensor([0.5, -0.5, 2.0, 0.3]))
    assert added.tolist() == [0.5, 0.0, 2.0, 0.0]
    assert (added + rest).tolist() == pytest.approx([0.5, -0.5, 2.0, 0.3])
    noise = 0.5 + 2 / 255 * torch.randn(1, 1, 60, 60, generator=torch.Generator().manual_seed(0))
    stds = [enhance(noise, ALPHA, threshold=t, num_landmarks=60).std() for t in (0.0, 5 / 255, 50 / 255)]
    assert stds[0] > 1.2 * stds[1]
    assert stds[1] > stds[2]
    assert stds[2] < 1.05 * noise.std()
    smooth = [enhance(noise, torch.tensor([0.0, 0.0, 1.0]), threshold=t, num_landmarks=60) for t in (0.0, 0.1)]
    assert torch.equal(smooth[0], smooth[1])


# --- the viewing size


@pytest.mark.parametrize("wanted", [(10, 15), (40, 60), (17, 33), (80, 61)])
def test_resizing_is_antialiased_bicubic_and_can_go_by_rows(wanted: tuple[int, int]) -> None:
    image = colour("coffee", 40, 60).double()
    found = resize(image, wanted)
    expected = F.interpolate(image, wanted, mode="bicubic", antialias=True)
    torch.testing.assert_close(found, expected, atol=1e-6 if wanted[0] <= 40 else 1e-4, rtol=0)
    rows = range(3, min(wanted[0], 9))
    part = resized(lambda start, stop: image[:, :, start:stop], (40, 60), wanted, rows)
    torch.testing.assert_close(part, found[:, :, 3:9])
    columns = range(2, min(wanted[1], 13))
    part = resized(lambda start, stop: image[:, :, start:stop], (40, 60), wanted, rows, columns)
    torch.testing.assert_close(part, found[:, :, 3:9, 2:13])


def test_the_viewing_size_of_a_picture() -> None:
    assert viewed_size((1000, 1500), 1.5) == (1000, 1500)
    assert viewed_size((2000, 3000), 1.5) == (1000, 1500)
    assert viewed_size((2000, 3000), 0) == (2000, 3000)
    assert viewed_size((1, 5_000_000), 1.5)[0] == 1


@pytest.mark.parametrize("name", EDITS)
def test_a_larger_picture_looks_alike_at_the_viewing_size(name: str) -> None:
    large, megapixels = colour("coffee", 180, 270), 60 * 90 / 1e6
    small = resize(large, (60, 90))
    wanted = EDITS[name](small, viewing_size=megapixels)
    assert torch.equal(wanted, EDITS[name](small, viewing_size=0))  # not larger: nothing is resized
    viewed = resize(EDITS[name](large, viewing_size=megapixels), (60, 90))
    per_pixel = resize(EDITS[name](large, viewing_size=0), (60, 90))

    def error(found: torch.Tensor) -> float:
        return float((found - wanted).square().mean().sqrt())

    change = float((wanted - small).square().mean().sqrt())
    assert error(viewed) < 0.4 * change
    assert error(viewed) < 0.7 * error(per_pixel)


def test_texture_too_fine_to_be_seen_is_changed_as_the_rest() -> None:
    generator = torch.Generator().manual_seed(0)
    image = (0.5 + 0.1 * torch.randn(1, 1, 120, 120, generator=generator)).clamp(0, 1)
    options: dict[str, Any] = {"viewing_size": 0.0036, "num_landmarks": 100, "photometric_bandwidth": 0.3}
    flat = enhance(image, torch.tensor([0.0, 0.0, 1.0]), **options)
    assert flat.std() < 0.5 * image.std()
    rich = enhance(image, torch.tensor([2.0, 2.0, 1.0]), limits="none", **options)
    assert 1.5 * image.std() < rich.std() < 2.2 * image.std()


@pytest.mark.parametrize("name", EDITS)
def test_gradients_go_through_the_viewing_size(name: str) -> None:
    image = colour("coffee", 40, 40).requires_grad_()
    EDITS[name](image, viewing_size=0.0004).square().mean().backward()
    assert image.grad is not None
    assert bool(torch.isfinite(image.grad).all())
    assert image.grad.abs().max() > 0


@pytest.mark.parametrize("saturation", [1.0, 3.0])
def test_tiles_are_those_of_the_edit_in_memory(saturation: float) -> None:
    image = colour("coffee", 120, 160)
    if saturation > 1:  # many channels at 0 and 1
        image = torch.lerp(luminance(image), image, saturation).clamp(0, 1)
    rows = image[0].permute(1, 2, 0).numpy().astype(np.float32)
    weights = np.zeros((120, 160, 1), np.float32)
    weights[20:40, 30:60] = 1
    for regions in (None, weights):
        planes = None if regions is None else torch.from_numpy(regions).permute(2, 0, 1)[None]
        for size in (0.005, 1.5):
            wanted = enhance(image, ALPHA, planes, num_landmarks=40, viewing_size=size)
            found = [np.empty_like(rows) for _ in range(2)]
            for target, height in zip(found, (7, 50), strict=True):
                stream_detail(
                    rows,
                    target,
                    ALPHA,
                    regions,
                    num_landmarks=40,
                    viewing_size=size,
                    statistics="full",
                    tile_rows=height,
                )
            assert np.abs(found[0] - wanted[0].permute(1, 2, 0).numpy()).max() < 2e-3
            assert np.abs(found[0] - found[1]).max() < 1e-6


def test_regions_of_another_size_are_told_at_the_viewing_size_too() -> None:
    image = colour("coffee", 40, 60)
    for size in (0, 0.001):
        with pytest.raises(ValueError, match=r"region.* must have the height and width"):
            enhance(image, ALPHA, torch.ones(1, 1, 40, 50), viewing_size=size, num_landmarks=20)
        with pytest.raises(ValueError, match=r"regions must be in \[0, 1\]"):
            enhance(image, ALPHA, -torch.ones(1, 1, 40, 60), viewing_size=size, num_landmarks=20)


# --- spatial bandwidth


def test_distance_counts_unless_told_otherwise(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    image = colour("coffee", 48, 72)
    near, given, far = (enhance(image, ALPHA, num_landmarks=60, spatial_bandwidth=h) for h in (None, 4.0, "none"))
    assert torch.equal(near, given)  # a twelfth of 48
    assert (far - near).abs().max() > 0.02
    with pytest.raises(ValueError, match="spatial_bandwidth must be one of 'none', got 'far'"):
        enhance(image, ALPHA, spatial_bandwidth="far")
    write_photograph(Photograph(image), tmp_path / "in.png")
    arguments = ["detail", str(tmp_path / "in.png"), str(tmp_path / "out.png"), "--landmarks", "60"]
    assert main([*arguments, "--alpha", "2.2,2.2,2.2,1", "--spatial-bandwidth", "none"]) == 0
    stored = read_photograph(tmp_path / "in.png").pixels
    wanted = enhance(stored, ALPHA, num_landmarks=60, spatial_bandwidth="none")
    assert (read_photograph(tmp_path / "out.png").pixels - wanted.clamp(0, 1)).abs().max() < 0.6 / 255
    assert main([*arguments, "--spatial-bandwidth", "far"]) == 2
    assert "--spatial-bandwidth must be a positive number of pixels, such as 20, or none" in capsys.readouterr().err


def test_weights_are_resized_by_themselves() -> None:
    mask = torch.zeros(2, 1, 40, 56)
    mask[..., 5:25, 5:30] = 1
    mask[0] *= 0.6
    both = InMemory(torch.zeros(2, 3, 40, 56)).resized_weights(mask, (20, 28), "mask")
    alone = InMemory(torch.zeros(1, 3, 40, 56)).resized_weights(mask[:1], (20, 28), "mask")
    assert torch.equal(both[:1], alone)
    assert both[0].max() == pytest.approx(0.6)
    rows = mask[:, 0].permute(1, 2, 0).numpy()  # the two as planes of one picture
    tiled = Tiled(Picture(np.zeros((40, 56, 3), np.float32)), Passes("float32"), "mask")
    found = torch.from_numpy(np.asarray(tiled.resized_weights(rows, (20, 28), "mask"))).permute(2, 0, 1)
    torch.testing.assert_close(found, both[:, 0], rtol=0, atol=1e-6)
