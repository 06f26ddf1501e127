"""Every edit: what it must keep, what it must change, its gradients and its bad input."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import skimage.data
import torch
import torch.nn.functional as F
from skimage.measure import label
from skimage.transform import resize

from nlfilter_torch import (
    abstract,
    adjust_tone,
    colorize,
    defocus,
    denoise,
    enhance,
    estimate_noise,
    nonlocal_operator,
    polynomial_filter,
    recolor,
    sharpen,
)
from nlfilter_torch.edits.chroma import group_colours, merge_luminance, region_means, split_luminance
from nlfilter_torch.edits.recolor import colour_guide
from nlfilter_torch.edits.spots import MAX_SPOTS, find_spots, label_spots
from tests.problems import noise

LUMINANCE = torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)


@cache
def colour(name: str, height: int = 64, width: int = 64) -> torch.Tensor:
    """A photograph (1, 3, height, width), reduced."""
    picture = getattr(skimage.data, name)() / 255
    return torch.from_numpy(resize(picture, (height, width), anti_aliasing=True)).permute(2, 0, 1)[None].float()


def box(top: int, left: int, height: int = 4, width: int = 4, size: tuple[int, int] = (64, 64)) -> torch.Tensor:
    mask = torch.zeros(1, 1, *size)
    mask[..., top : top + height, left : left + width] = 1
    return mask


def paint(red: float, green: float, blue: float, mask: torch.Tensor) -> torch.Tensor:
    return torch.tensor([red, green, blue]).view(1, 3, 1, 1) * mask


def luminance(image: torch.Tensor) -> torch.Tensor:
    return (image * LUMINANCE.to(image)).sum(1, keepdim=True)


def blue_suit(image: torch.Tensor, **options: object) -> torch.Tensor:
    stroke = box(37, 8)
    return recolor(image, paint(0.1, 0.3, 0.9, stroke), stroke, **options)


SUIT = (slice(None), slice(None), slice(36, 50), slice(8, 15))
BACKGROUND = (slice(None), slice(None), slice(2, 18), slice(40, 46))


# --- recolour


def test_recolour_keeps_luminance_and_what_is_unlike() -> None:
    image = colour("astronaut")
    edited = blue_suit(image)
    assert (luminance(edited) - luminance(image)).abs().max() <= 1 / 255
    assert torch.equal(edited[BACKGROUND], image[BACKGROUND])
    assert (edited == image).all(1).float().mean() > 0.5
    suit = edited[SUIT]
    assert (suit[:, 2] > suit[:, 0]).float().mean() > 0.9
    assert (image[SUIT][:, 2] < image[SUIT][:, 0]).all()
    assert edited.min() >= -1e-6
    assert edited.max() <= 1 + 1e-6


def test_recolour_within_two_levels_outside_a_kept_region() -> None:
    image, stroke = colour("coffee", 64, 96), box(38, 20, size=(64, 96))
    keep = box(2, 40, 4, 50, size=(64, 96))
    edited = recolor(image, paint(0.1, 0.6, 0.2, stroke), stroke, keep=keep)
    kept = (keep > 0).expand_as(image)
    assert (edited - image)[kept].abs().max() <= 2 / 255
    painted = (stroke > 0)[0, 0]
    assert (edited[0, 1][painted] > edited[0, 0][painted]).all()


def test_one_stroke_does_not_spill() -> None:
    """Odd pixels under it, here of the backdrop, are painted but do not take their likes along."""
    image, stroke = colour("astronaut"), box(37, 8, 5, 5)
    image = torch.where(box(37, 8, 1, 5) > 0, image[..., 6:7, 42:43], image)
    edited = recolor(image, paint(0.1, 0.3, 0.9, stroke), stroke)
    assert torch.equal(edited[BACKGROUND], image[BACKGROUND])
    assert (edited[SUIT][:, 2] > edited[SUIT][:, 0]).float().mean() > 0.9
    assert (edited != image).any(1).float().mean() < 0.4


def test_a_pixel_a_hundred_dots_and_everything_may_be_painted() -> None:
    image = colour("astronaut")
    dot = box(40, 10, 1, 1)
    suit = recolor(image, paint(0.1, 0.3, 0.9, dot), dot)[SUIT]
    assert (suit[:, 2] > suit[:, 0]).float().mean() > 0.7
    dots = torch.zeros(1, 1, 64, 64)
    dots[..., 1::6, 1::6] = 1  # 121 spots of one colour
    for mask in (dots, torch.ones(1, 1, 64, 64)):
        edited = recolor(image, paint(0.1, 0.3, 0.9, mask), mask)
        inside = (mask > 0)[0, 0]
        assert (edited[0, 2][inside] >= edited[0, 0][inside] - 1e-4).all()
        assert (luminance(edited) - luminance(image)).abs().max() <= 1 / 255


def test_two_colours_reach_their_own_likes() -> None:
    image = torch.full((1, 3, 40, 40), 0.5)
    image[:, 0, :, :20], image[:, 2, :, 20:] = 0.8, 0.8  # reddish, bluish
    left, right = box(4, 4, size=(40, 40)), box(30, 30, size=(40, 40))
    strokes = paint(0, 1, 0, left) + paint(1, 1, 0, right)
    edited = recolor(image, strokes, left + right, num_landmarks=40)
    wanted = split_luminance(paint(0, 1, 0, torch.ones(1, 1, 1, 1)))[1]
    chroma = split_luminance(edited)[1]
    for columns, chroma_wanted in (
        (slice(0, 16), wanted),
        (slice(24, 40), split_luminance(paint(1, 1, 0, torch.ones(1, 1, 1, 1)))[1]),
    ):
        cosine = F.cosine_similarity(chroma[..., columns], chroma_wanted.expand_as(chroma[..., columns]), dim=1)
        assert cosine.min() > 0.99


def test_overlapping_strokes_are_decided_by_the_colour_on_top() -> None:
    """Strokes are one picture: what was painted last is what it shows."""
    image = colour("astronaut")
    under, over = box(36, 8, 6, 6), box(37, 9, 4, 4)
    strokes = torch.where(over > 0, paint(0.1, 0.3, 0.9, over), paint(0, 0.8, 0, under))
    regions, colours, counts = group_colours(split_luminance(strokes)[1], torch.maximum(under, over))
    assert counts.all()
    assert regions.sum((2, 3)).tolist() == [[20.0, 16.0]]
    edited = recolor(image, strokes, torch.maximum(under, over))
    assert torch.isfinite(edited).all()
    assert colours.shape == (1, 2, 3)


def test_a_grey_stroke_takes_colour_away() -> None:
    stroke = box(37, 8)
    edited = recolor(colour("astronaut"), paint(0.5, 0.5, 0.5, stroke), stroke)
    assert (
        split_luminance(edited[SUIT])[1].abs().mean() < 0.1 * split_luminance(colour("astronaut")[SUIT])[1].abs().mean()
    )


# --- colourise


def test_colours_come_back_from_strokes() -> None:
    image = colour("coffee", 60, 90)
    mask = torch.zeros(1, 1, 60, 90)
    for row, column in np.random.default_rng(0).integers(0, (56, 86), (12, 2)):
        mask[..., row : row + 4, column : column + 4] = 1
    found = colorize(luminance(image), image * mask, mask)
    assert (luminance(found) - luminance(image)).abs().max() < 1e-4
    assert (found - image).square().mean() < 0.3 * (luminance(image) - image).square().mean()
    pieces = colorize(luminance(image), image * mask, mask, method="kmeans")
    assert (luminance(pieces) - luminance(image)).abs().max() < 1e-4
    assert not torch.equal(pieces, found)


def test_strength_decides_what_becomes_of_the_rest() -> None:
    grey = torch.full((1, 1, 40, 40), 0.2)
    grey[..., 20:] = 0.8
    stroke = box(10, 4, size=(40, 40))

    def chroma(strength: float) -> torch.Tensor:
        found = colorize(grey, paint(0.4, 0.1, 0.1, stroke), stroke, strength=strength, num_landmarks=40)
        return split_luminance(found)[1][..., 26:].abs().mean()

    assert chroma(0.0) < 0.01 < chroma(0.5) < chroma(1.0)


def test_one_pixel_and_all_pixels_may_be_painted() -> None:
    image = colour("chelsea", 40, 60)
    dot = box(20, 30, 1, 1, size=(40, 60))
    wanted = split_luminance(image)[1][..., 20:21, 30:31]
    found = split_luminance(colorize(luminance(image), image * dot, dot))[1]
    torch.testing.assert_close(found[..., 20:21, 30:31], wanted, atol=0.02, rtol=0)
    full = colorize(luminance(image), image, torch.ones(1, 1, 40, 60))
    assert (full - image).abs().mean() < 0.01


def test_a_colour_too_strong_for_its_luminance_is_weakened() -> None:
    grey, chroma = torch.tensor([0.05, 0.5, 0.98]).view(1, 1, 1, 3), paint(1, 0, 0, torch.ones(1, 1, 1, 3))
    found = merge_luminance(grey, split_luminance(chroma)[1])
    assert found.min() >= 0
    assert found.max() <= 1
    torch.testing.assert_close(luminance(found), grey)


def test_groups_of_colours_are_kept_apart_image_by_image() -> None:
    chroma = torch.zeros(2, 3, 1, 40)
    chroma[0, 0] = torch.arange(40) * 0.1  # forty colours
    regions, means, counts = group_colours(chroma, torch.ones(2, 1, 1, 40))
    assert regions.shape == (2, 16, 1, 40)
    assert counts[0].all()
    assert counts[1].tolist() == [True] + [False] * 15
    torch.testing.assert_close(regions[0].sum(0), torch.ones(1, 40))  # further ones joined the nearest
    assert torch.equal(means[1], torch.zeros(16, 3))


# --- defocus


def gradient_energy(image: torch.Tensor, mask: torch.Tensor) -> float:
    rows, columns = image.diff(dim=2)[..., :-1], image.diff(dim=3)[..., :-1, :]
    return float(((rows.square() + columns.square()) * mask[..., :-1, :-1]).sum())


@pytest.mark.parametrize("aperture", ["disc", "gaussian"])
def test_the_subject_stays_sharp_and_the_rest_does_not(aperture: str) -> None:
    image = colour("astronaut", 128, 128)
    region = box(15, 47, 15, 15, size=(128, 128)) + box(65, 10, 40, 8, size=(128, 128))
    blurred = defocus(image, region, radius=4.0, aperture=aperture)
    assert torch.equal(blurred[(region > 0).expand_as(image)], image[(region > 0).expand_as(image)])
    face = box(22, 45, 20, 18, size=(128, 128))
    assert gradient_energy(blurred, face) >= 0.95 * gradient_energy(image, face)
    far = box(0, 95, 60, 33, size=(128, 128))  # the shuttle
    assert gradient_energy(blurred, far) < 0.3 * gradient_energy(image, far)
    assert blurred.min() >= image.min() - 1e-4
    assert blurred.max() <= image.max() + 1e-4


def test_the_subject_does_not_bleed() -> None:
    """A white subject on black leaves no glow, where a plain blur would."""
    image = torch.zeros(1, 1, 60, 60)
    image[..., 20:40, 20:40] = 1
    blurred = defocus(image, box(22, 22, 16, 16, size=(60, 60)), radius=5.0, num_landmarks=40)
    outside = torch.ones(1, 1, 60, 60)
    outside[..., 17:43, 17:43] = 0
    plain = F.avg_pool2d(image, 9, stride=1, padding=4)
    assert blurred[outside > 0].max() < 0.15 * plain[outside > 0].max()


def test_a_dot_may_be_in_focus_and_everything_may() -> None:
    image = colour("astronaut")
    assert torch.equal(defocus(image, torch.ones(1, 1, 64, 64), radius=3.0), image)
    dot = box(40, 10, 1, 1)
    blurred = defocus(image, dot, radius=3.0)
    assert torch.equal(blurred[..., 40, 10], image[..., 40, 10])
    near, far = box(36, 8, 8, 6), box(4, 44, 20, 16)
    assert gradient_energy(blurred, near) / gradient_energy(image, near) > 0.8
    assert gradient_energy(blurred, far) / gradient_energy(image, far) < 0.5


def test_odd_pixels_of_the_subject_do_not_bring_the_background_into_focus() -> None:
    image = colour("astronaut", 128, 128)
    region = box(65, 10, 40, 8, size=(128, 128))
    odd = box(65, 10, 2, 8, size=(128, 128))  # shows the backdrop
    image = torch.where(odd > 0, image[..., 10:11, 85:86], image)
    blurred = defocus(image, region, radius=4.0)
    far = box(0, 95, 60, 33, size=(128, 128))
    assert gradient_energy(blurred, far) < 0.3 * gradient_energy(image, far)


def test_spots_beyond_the_last_that_is_kept_apart_are_taken_together() -> None:
    image = colour("astronaut")
    spectrum = nonlocal_operator(image, num_landmarks=40, photometric_bandwidth=0.2, guide_channels="all").spectrum()
    dots = torch.zeros(1, 2, 64, 64)
    dots[:, 0, 1::4, 1::4], dots[:, 1, 3::16, 3::16] = 0.5, 1.0  # 256 and 16
    (spots,) = find_spots(spectrum, dots, 0.5)
    assert spots.owners.sum(0).tolist() == [MAX_SPOTS, 16]
    torch.testing.assert_close(spots.between.diagonal(), torch.ones(MAX_SPOTS + 16), atol=1e-4, rtol=0)
    each = spots.mix(torch.eye(MAX_SPOTS + 16))
    assert each.abs().max() <= 1 + 1e-3
    single = dots[0, 1].flatten() > 0  # a dot correlates with itself fully
    torch.testing.assert_close(each[MAX_SPOTS:, single].diagonal(), torch.ones(16), atol=1e-3, rtol=0)


def test_spots_are_what_is_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.edits.spots.MAX_SPOTS", 10**9)
    for number, size in enumerate([(1, 1), (1, 9), (9, 1), (7, 8), (40, 31)]):
        for density in (0.1, 0.3, 0.5, 0.8, 1.0):
            planes = torch.rand(3, *size, generator=torch.Generator().manual_seed(number)) < density
            planes[0, 0, 0] = True
            regions, places = planes.flatten(1).nonzero().unbind(1)
            spots, owners = label_spots(places, regions, size)
            parts = [label(plane.numpy(), connectivity=2) for plane in planes]
            counts = torch.tensor([part.max() for part in parts])
            offsets = counts.cumsum(0) - counts - 1
            wanted = torch.cat([torch.from_numpy(p[p > 0]) + o for p, o in zip(parts, offsets, strict=True)])
            assert torch.equal(spots, wanted)
            assert torch.equal(owners, torch.arange(3).repeat_interleave(counts))


def test_a_colour_is_the_same_to_the_last_bit_wherever_it_stands() -> None:
    image = colour("astronaut", 61, 83)
    guide = colour_guide(image)
    for rows in (slice(0, 1), slice(3, 10), slice(20, 61)):
        assert torch.equal(colour_guide(image[:, :, rows]), guide[:, :, rows])


def test_flat_images_stay_flat() -> None:
    flat = torch.full((1, 3, 24, 30), 0.3)
    torch.testing.assert_close(defocus(flat, box(4, 4, size=(24, 30))), flat, atol=1e-5, rtol=0)


# --- abstract


def test_abstraction_fades_with_its_power() -> None:
    image = colour("chelsea", 48, 72)
    torch.testing.assert_close(abstract(image, power=0.0), image, atol=1e-5, rtol=0)
    changes = [float((abstract(image, power=p) - image).square().mean().sqrt()) for p in (1e-5, 1e-3, 0.1, 1.0)]
    assert changes == sorted(changes)
    assert changes[0] < 1e-4
    assert changes[2] > 0.01


def test_what_is_like_nothing_else_is_not_blackened() -> None:
    """A border that few landmarks stand for stays between its two fields, and these stay what they are."""
    image = torch.full((1, 1, 40, 60), 0.4)
    image[..., 30:] = 0.9
    image[..., 29] = 0.65
    found = abstract(image, num_landmarks=100)
    torch.testing.assert_close(found[..., 29], image[..., 29], atol=0.01, rtol=0)
    assert found.min() > 0.34
    assert found.max() < 0.98


def test_tones_and_lines() -> None:
    image = colour("chelsea", 48, 72)
    plain, toned, lined = abstract(image), abstract(image, tones=4), abstract(image, edges=1.0)

    def near_a_tone(picture: torch.Tensor) -> float:
        """Share of pixels close to one of the tones, which lie half-way between thirds."""
        return float(((luminance(picture) * 3 - 0.5).frac().sub(0.5).abs() > 0.4).float().mean())

    assert near_a_tone(toned) > 2 * near_a_tone(plain)
    assert (luminance(lined) <= luminance(plain) + 1e-5).all()
    assert (luminance(lined) < 0.5 * luminance(plain)).float().mean() > 0.02
    torch.testing.assert_close(abstract(image, edges=0.5) + 0, (plain + lined) / 2, atol=0.1, rtol=0)
    grey = abstract(luminance(image), tones=4, edges=1.0)
    assert grey.shape == (1, 1, 48, 72)


# --- denoise


@pytest.mark.parametrize("level", [10, 25])
def test_denoising_brings_the_photograph_closer(level: int) -> None:
    clean = colour("chelsea", 64, 96)
    noisy = clean + level / 255 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    for given in (level / 255, None):
        gain = 10 * torch.log10(
            (noisy - clean).square().mean() / (denoise(noisy, noise_level=given) - clean).square().mean()
        )
        assert gain > (2.0 if level == 10 else 5.0)


def test_no_noise_means_no_change() -> None:
    image = colour("coffee", 32, 48)
    assert torch.equal(denoise(image, noise_level=0.0), image)
    flat = torch.full((1, 1, 20, 20), 0.5)
    assert torch.equal(denoise(flat), flat)
    each = denoise(torch.cat([image, image]), noise_level=torch.tensor([0.0, 0.1]))
    assert torch.equal(each[:1], image)
    assert not torch.equal(each[1:], image)


def test_noise_is_estimated() -> None:
    level = 15 / 255
    noisy = 0.5 + level * torch.randn(2, 3, 80, 80, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(estimate_noise(noisy), torch.full((2,), level), atol=0.003, rtol=0)
    ramp = torch.linspace(0, 1, 80).expand(1, 1, 80, 80) + torch.linspace(0, 1, 80).unsqueeze(1)
    assert estimate_noise(ramp).item() < 1e-6
    assert estimate_noise(torch.rand(1, 1, 2, 2, generator=torch.Generator().manual_seed(0))).item() == 0


# --- tone and detail


def test_tone_holds_mean_and_colours() -> None:
    image = colour("coffee", 40, 60)
    strong = adjust_tone(image, contrast=1.4, clarity=3.0)
    torch.testing.assert_close(strong.mean((2, 3)), image.mean((2, 3)), atol=1e-5, rtol=0)
    torch.testing.assert_close(split_luminance(strong)[1], split_luminance(image)[1], atol=1e-5, rtol=0)
    assert luminance(strong).std() > 1.2 * luminance(image).std()
    torch.testing.assert_close(adjust_tone(image), image, atol=1e-5, rtol=0)
    grey = luminance(image)
    operator = nonlocal_operator(grey)
    mean = grey.mean()
    expected = mean + polynomial_filter(operator, grey - mean, torch.tensor([1.0, 1.0, 3.0, 1.4]))
    torch.testing.assert_close(adjust_tone(grey, contrast=1.4, clarity=3.0), expected)


def test_sharpening_raises_edges_and_spares_noise() -> None:
    clean = luminance(colour("astronaut", 96, 96))
    noisy = clean + 10 / 255 * torch.randn(2, 1, 96, 96, generator=torch.Generator().manual_seed(0))
    sharp = sharpen(noisy, amount=5.0)
    direction = torch.stack([clean.diff(dim=3)[..., :-1, :], clean.diff(dim=2)[..., :-1]])
    strength = direction.norm(dim=0)
    strong = strength > strength.quantile(0.95)

    def slope(image: torch.Tensor) -> torch.Tensor:
        mean = image.mean(0, keepdim=True)
        gradient = torch.stack([mean.diff(dim=3)[..., :-1, :], mean.diff(dim=2)[..., :-1]])
        return ((gradient * direction).sum(0) / strength)[strong].mean()

    wall = (slice(None), slice(None), slice(2, 18), slice(58, 70))
    assert slope(sharp) > 1.2 * slope(noisy)
    assert (sharp[0] - sharp[1])[wall[1:]].std() < 1.2 * (noisy[0] - noisy[1])[wall[1:]].std()
    torch.testing.assert_close(sharpen(clean, amount=1.0), clean, atol=1e-5, rtol=0)
    assert not torch.equal(sharpen(clean), sharpen(clean, guide_blur=0.0))


def test_detail_reaches_the_likes_of_a_region_only() -> None:
    image = colour("astronaut")
    sliders = torch.tensor([4.0, 4.0, 4.0, 1.0])
    whole = enhance(image, sliders)
    torch.testing.assert_close(enhance(image, torch.ones(4)), image, atol=1e-5, rtol=0)
    part = enhance(image, sliders, box(37, 8))
    change, full = (part - image).abs().mean(1), (whole - image).abs().mean(1)
    assert change[0, 36:50, 8:15].mean() > 0.4 * full[0, 36:50, 8:15].mean()
    assert change[0, 2:18, 40:46].mean() < 0.15 * full[0, 2:18, 40:46].mean()
    none = enhance(image, sliders, box(37, 8), negative=box(37, 8))
    assert (none - image).abs().mean() < (part - image).abs().mean()
    two = enhance(
        image, torch.stack([sliders, torch.tensor([0.0, 0.0, 1.0, 1.0])]), torch.cat([box(37, 8), box(4, 42)], 1)
    )
    assert (two - part).abs()[BACKGROUND].max() > 0
    everything = enhance(image, sliders, torch.ones(1, 1, 64, 64))
    assert torch.isfinite(everything).all()
    dot = enhance(image, sliders, box(40, 10, 1, 1))
    share = [((dot - image).abs()[place].mean() / (whole - image).abs()[place].mean()) for place in (SUIT, BACKGROUND)]
    assert share[0] > 3 * share[1]
    with pytest.raises(ValueError, match="negative must come with regions, got it alone"):
        enhance(image, sliders, negative=box(1, 1))
    with pytest.raises(ValueError, match=r"alpha must have shape \(1, k\+1\)"):
        enhance(image, torch.ones(2, 4), box(1, 1))


# --- all of them

GREY = 0.2 + 0.6 * noise(2, 1, 20, 22, dtype=torch.float32)
RGB = 0.2 + 0.6 * noise(2, 3, 20, 22, dtype=torch.float32)
SPOT = box(4, 4, size=(20, 22))
Edit = Callable[[torch.Tensor], torch.Tensor]
EDITS: dict[str, tuple[torch.Tensor, Edit]] = {
    "recolor": (RGB, lambda x: recolor(x, paint(0, 0, 1, SPOT).to(x), SPOT.to(x), num_landmarks=30)),
    "colorize": (GREY, lambda x: colorize(x, paint(0, 0, 0.5, SPOT).to(x), SPOT.to(x), num_landmarks=30)),
    "kmeans": (
        GREY,
        lambda x: colorize(x, paint(0, 0, 0.5, SPOT).to(x), SPOT.to(x), method="kmeans", num_landmarks=30),
    ),
    "defocus": (RGB, lambda x: defocus(x, SPOT.to(x), radius=2.0, num_landmarks=30)),
    "abstract": (RGB, lambda x: abstract(x, tones=6, edges=0.5, num_landmarks=30)),
    "denoise": (RGB, lambda x: denoise(x, noise_level=0.1, num_landmarks=30)),
    "adjust_tone": (RGB, lambda x: adjust_tone(x, contrast=1.2, clarity=2.0, num_landmarks=30)),
    "sharpen": (RGB, lambda x: sharpen(x, amount=3.0, num_landmarks=30)),
    "enhance": (RGB, lambda x: enhance(x, torch.tensor([2.0, 1.5, 1.0]), SPOT.to(x), num_landmarks=30)),
}
each_edit = pytest.mark.parametrize("name", EDITS)


@each_edit
@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_edits_keep_dtype_and_input(name: str, dtype: torch.dtype) -> None:
    image, edit = EDITS[name]
    given = image.to(dtype)
    before = given.clone()
    found = edit(given)
    assert found.dtype == dtype
    assert found.shape == (2, 3, 20, 22)
    assert torch.isfinite(found).all()
    assert torch.equal(given, before)


@each_edit
def test_edits_of_a_batch_are_those_of_its_images(name: str) -> None:
    image, edit = EDITS[name]
    image = image.double()
    torch.testing.assert_close(edit(image), torch.cat([edit(image[:1]), edit(image[1:])]), atol=1e-5, rtol=0)


@each_edit
def test_edits_are_repeatable_and_leave_the_global_generator_alone(name: str) -> None:
    image, edit = EDITS[name]
    state = torch.get_rng_state()
    assert torch.equal(edit(image), edit(image))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("name", [name for name in EDITS if name != "kmeans"])
def test_edits_have_finite_gradients(name: str) -> None:
    image, edit = EDITS[name]
    given = image.double().requires_grad_()
    weights = noise(2, 3, 20, 22, seed=3)
    (edit(given) * weights).sum().backward()
    assert given.grad is not None
    assert given.grad.isfinite().all()
    assert given.grad.abs().max() > 0


@each_edit
def test_edits_refuse_integers_and_other_shapes(name: str) -> None:
    image, edit = EDITS[name]
    with pytest.raises(TypeError, match="must be of a floating-point dtype with values in"):
        edit((image * 255).byte())
    with pytest.raises(ValueError, match=r"must have shape \(B, C, H, W\)"):
        edit(image[0])
    with pytest.raises(ValueError, match="must be finite, got"):
        edit(image.clone().fill_(torch.nan))


STROKES = {"strokes": paint(1, 0, 0, SPOT), "stroke_mask": SPOT}


@pytest.mark.parametrize(
    ("edit", "image", "arguments", "sentence"),
    [
        (recolor, GREY, STROKES, r"image must have 3 channel\(s\), got 1"),
        (recolor, RGB, {**STROKES, "stroke_mask": 0 * SPOT}, "stroke_mask must hold a painted pixel in every image"),
        (recolor, RGB, {**STROKES, "stroke_mask": 2 * SPOT}, r"stroke_mask must be in \[0, 1\]"),
        (
            recolor,
            RGB,
            {**STROKES, "strokes": torch.ones(1, 3, 9, 9)},
            "strokes must have the height and width of the image",
        ),
        (recolor, RGB, {**STROKES, "keep": torch.ones(1, 1, 9, 9)}, "keep must have the height and width of the image"),
        (recolor, RGB, {**STROKES, "reach": 1.0}, r"reach must be in \[0, 1\)"),
        (colorize, RGB, STROKES, r"grey must have 1 channel\(s\), got 3; select or convert the channels"),
        (colorize, GREY, {**STROKES, "stroke_mask": 0 * SPOT}, "stroke_mask must hold a painted pixel"),
        (colorize, GREY, {**STROKES, "method": "levin"}, "method must be one of 'regression', 'kmeans', got 'levin'"),
        (colorize, GREY, {**STROKES, "strength": 2.0}, r"strength must be in \[0, 1\]"),
        (
            colorize,
            GREY,
            {**STROKES, "strokes": torch.ones(3, 3, 20, 22)},
            "strokes must have batch size 1 or 2, got 3",
        ),
        (defocus, RGB, {"focus_region": 0 * SPOT}, "focus_region must hold a painted pixel"),
        (defocus, RGB, {"focus_region": SPOT, "radius": 0.0}, "radius must be positive"),
        (defocus, RGB, {"focus_region": SPOT, "aperture": "square"}, "aperture must be one of 'disc', 'gaussian'"),
        (defocus, RGB[:, :2], {"focus_region": SPOT}, "image must have 1 or 3 channels, got 2"),
        (defocus, RGB, {"focus_region": SPOT[..., :9]}, "focus_region must have the height and width of the image"),
        (abstract, RGB, {"power": -1.0}, "power must be at least 0 and finite, got -1"),
        (abstract, RGB, {"edges": 2.0}, r"edges must be in \[0, 1\], got 2"),
        (abstract, RGB, {"edge_width": 0.0}, "edge_width must be positive"),
        (abstract, RGB, {"tones": 1}, "tones must be at least 2, got 1"),
        (abstract, RGB[:, :2], {"tones": 4}, "image must have 1 or 3 channels for edges and tones, got 2"),
        (denoise, RGB, {"noise_level": -0.1}, "noise_level must be at least 0 and finite"),
        (sharpen, RGB, {"guide_blur": -1.0}, "guide_blur must be at least 0, got -1"),
        (adjust_tone, RGB, {"order": 0}, "order must be at least 1, got 0"),
    ],
)
def test_bad_input(edit: Callable[..., torch.Tensor], image: torch.Tensor, arguments: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        edit(image, **arguments)


def test_means_of_regions_are_exact_on_large_images() -> None:
    mask = box(300, 300, 600, 600, size=(1400, 1400)) * 0.7
    image = 0.9 + 0.1 * noise(1, 3, 1400, 1400, dtype=torch.float32)
    wanted = (image.double() * mask.double()).sum((2, 3)) / mask.double().sum()
    torch.testing.assert_close(region_means(image, mask)[:, 0].double(), wanted, rtol=0, atol=1e-7)
