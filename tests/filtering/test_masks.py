"""Diffusion maps and masks: against the dense reference, and properties of every mask."""

from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.color import rgb2hsv

from nlfilter_torch import (
    Spectrum,
    compose_alpha,
    diffusion_map,
    diffusion_mask,
    fit_alpha,
    nonlocal_operator,
    operator_from_features,
    segment_mask,
)
from tests import reference
from tests.images import photograph, two_colours
from tests.pairwise import each_value
from tests.problems import build, guides, noise, options, picture

SIDE = 24
H_Y = 30 / 255


@pytest.fixture(scope="module")
def dense() -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and eigenvectors of the dense filter of a small photograph."""
    return reference.eigenpairs(reference.filter_matrix(photograph("astronaut", SIDE, SIDE), 5, H_Y))


@pytest.fixture(scope="module")
def spectrum() -> object:
    """The spectrum of the same filter from the library, with every pixel a landmark."""
    guide = picture("astronaut", SIDE, SIDE)
    return nonlocal_operator(guide, photometric_bandwidth=H_Y, num_landmarks=SIDE * SIDE).spectrum()


def regions(count: int = 1, height: int = SIDE, width: int = SIDE) -> torch.Tensor:
    """Rectangles (1, count, height, width) in several places."""
    region = torch.zeros(1, count, height, width, dtype=torch.float64)
    for k in range(count):
        top, left = (5 * k) % (height - 4), (7 * k) % (width - 4)
        region[0, k, top : top + 4, left : left + 4] = 1
    return region


@pytest.mark.parametrize("time", [0.5, 1.0, 3.0])
def test_distances_are_those_of_the_dense_map(spectrum, dense, time: float) -> None:
    s, v = dense
    expected = reference.diffusion_map(s, v, time)
    result = diffusion_map(spectrum, time=time).flatten(2)[0]
    for pixel in (0, 100, 333):
        np.testing.assert_allclose(
            (result - result[:, pixel : pixel + 1]).square().sum(0),
            reference.diffusion_distance(expected, expected[pixel]),
            rtol=2e-3,
            atol=2e-2,  # for distances up to several hundred
        )


@pytest.mark.parametrize(("time", "width"), each_value([0.5, 1.0, 3.0], [1.0, 4.0, 40.0]))
def test_mask_is_that_of_the_dense_paper(spectrum, dense, time: float, width: float) -> None:
    s, v = dense
    region = regions(3)
    result = diffusion_mask(spectrum, region, time=time, width=width)
    expected = [reference.diffusion_mask(s, v, r.numpy().ravel(), time, width) for r in region[0]]
    np.testing.assert_allclose(result.flatten(2)[0], np.stack(expected), atol=5e-3)


def test_partition_is_that_of_the_dense_paper(spectrum, dense) -> None:
    region = regions(3)
    result = segment_mask(spectrum, region, time=1.0).flatten(2)[0].numpy()
    expected = reference.segment_mask(*dense, region.flatten(2)[0].numpy(), 1.0, steps=20)
    assert (result == expected).mean() > 0.99


@given(guide=guides(), chosen=options, time=st.floats(0.1, 10), width=st.floats(0.1, 100), seed=st.integers(0, 99))
def test_masks_are_in_range(
    guide: torch.Tensor, chosen: dict[str, object], time: float, width: float, seed: int
) -> None:
    spectrum = build(guide, **chosen).spectrum()
    region = noise(guide.shape[0], 2, *guide.shape[2:], seed=seed)
    mask = diffusion_mask(spectrum, region, time=time, width=width)
    assert mask.shape == region.shape
    assert mask.isfinite().all()
    assert (mask > 0).all()
    assert (mask <= 1).all()
    later = diffusion_mask(spectrum, region, time=2 * time, width=width)
    assert (later >= mask - 1e-5).all()
    partition = segment_mask(spectrum, region, time=time)
    assert partition.shape == region.shape
    assert (partition.sum(1) == 1).all()
    assert ((partition == 0) | (partition == 1)).all()


def test_masks_keep_colours_apart() -> None:
    guide = torch.from_numpy(two_colours())[None, None]
    spectrum = build(guide, photometric_bandwidth=20 / 255, num_landmarks=30).spectrum()
    region = torch.zeros_like(guide)
    region[..., 2:5, 2:5] = 1
    mask = diffusion_mask(spectrum, region)
    dark, light = mask[..., :20], mask[..., 28:]  # away from patches that contain both
    assert dark.min() > 0.95
    assert light.max() < 0.5
    parts = segment_mask(spectrum, torch.cat([region, region.flip(-1)], dim=1))
    assert (parts[0, 0, :, :20] == 1).all()
    assert (parts[0, 1, :, 28:] == 1).all()


def test_map_leaves_the_constant_out_and_has_unit_rms() -> None:
    spectrum = build(picture("camera", 24, 30), photometric_bandwidth=0.2, num_landmarks=40).spectrum()
    coordinates = diffusion_map(spectrum, time=1.0)
    assert coordinates.shape == (1, spectrum.eigenvalues.shape[1] - 1, 24, 30)
    rms = coordinates.square().mean((2, 3)).sqrt()
    torch.testing.assert_close(rms, spectrum.eigenvalues[:, 1:], atol=1e-6, rtol=0)


def test_masks_do_not_depend_on_the_size_of_the_image() -> None:
    """A picture and its double have the same distances, up to the borders of patches."""
    guide = torch.from_numpy(two_colours(20, 24))[None, None]
    kwargs = {"photometric_bandwidth": 60 / 255, "num_landmarks": 20}
    small = diffusion_mask(build(guide, patch_size=1, **kwargs).spectrum(), regions(1, 20, 24))
    region = regions(1, 20, 24).repeat_interleave(2, -1).repeat_interleave(2, -2)
    doubled = guide.repeat_interleave(2, -1).repeat_interleave(2, -2)
    large = diffusion_mask(build(doubled, patch_size=1, **kwargs).spectrum(), region)
    torch.testing.assert_close(large[..., ::2, ::2], small, atol=1e-4, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_masks_keep_the_dtype_of_the_region(dtype: torch.dtype) -> None:
    spectrum = build(noise(1, 1, SIDE, SIDE), num_landmarks=20).spectrum()
    assert diffusion_mask(spectrum, regions().to(dtype)).dtype == dtype
    assert segment_mask(spectrum, regions(2).to(dtype)).dtype == dtype


def test_a_batch_is_its_images() -> None:
    guide = torch.cat([picture(name, 24, 30) for name in ("astronaut", "camera")])
    region = noise(2, 2, 24, 30)
    together = diffusion_mask(build(guide, num_landmarks=40).spectrum(), region)
    alone = [diffusion_mask(build(guide[i : i + 1], num_landmarks=40).spectrum(), region[i : i + 1]) for i in range(2)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", ["astronaut", "two colours"])
def test_gradients_are_finite_where_eigenvalues_meet(name: str) -> None:
    guide = picture("astronaut", 10, 12) if name == "astronaut" else torch.from_numpy(two_colours(10, 12))[None, None]
    guide = guide.clone().requires_grad_()
    time = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    spectrum = build(guide, photometric_bandwidth=0.3, num_landmarks=15).spectrum()
    diffusion_mask(spectrum, regions(1, 10, 12), time=time, width=40.0).square().sum().backward()
    for tensor in (guide, time):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
        assert tensor.grad.abs().max() > 0


# --- a mask from a spot on the astronaut's suit


def astronaut(side: int) -> torch.Tensor:
    """The astronaut in colour, (1, 3, side, side)."""
    whole = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1)[None].float() / 255
    return torch.nn.functional.avg_pool2d(whole, 512 // side)


def suit_spot(side: int) -> torch.Tensor:
    """A square on the suit, 20 pixels wide at 512."""
    scale = side / 512
    region = torch.zeros(1, 1, side, side)
    region[..., int(300 * scale) : int(320 * scale), int(60 * scale) : int(80 * scale)] = 1
    return region


@pytest.fixture(scope="module")
def by_colour() -> dict[int, Spectrum]:
    return {
        side: nonlocal_operator(astronaut(side), photometric_bandwidth=25 / 255, guide_channels="all").spectrum()
        for side in (256, 512)
    }


@pytest.mark.slow
def test_a_spot_on_the_suit_selects_the_suit(by_colour: dict[int, Spectrum]) -> None:
    mask = diffusion_mask(by_colour[512], suit_spot(512), time=1.0)
    hue, saturation, value = rgb2hsv(skimage.data.astronaut()).transpose(2, 0, 1)
    below_collar = np.arange(512)[:, None] > 200
    suit = torch.from_numpy((hue > 0.01) & (hue < 0.08) & (saturation > 0.6) & (value > 0.35) & below_collar)
    assert 0.15 < suit.float().mean() < 0.25
    assert mask[0, 0][suit].mean() >= 3 * mask[0, 0][~suit].mean()
    assert mask.min() > 0
    assert mask.max() <= 1


@pytest.mark.slow
def test_masks_grow_with_time_at_every_quantile(by_colour: dict[int, Spectrum]) -> None:
    levels = torch.linspace(0, 1, 21)
    masks = [diffusion_mask(by_colour[256], suit_spot(256), time=t).flatten() for t in (0.5, 1.0, 2.0, 5.0)]
    quantiles = torch.stack([torch.quantile(mask, levels) for mask in masks])
    assert (quantiles.diff(dim=0) >= 0).all()
    assert (quantiles.diff(dim=0)[:, 1:-1] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.5, 1.0, 2.0])
def test_a_preview_has_the_mask_of_the_photograph(by_colour: dict[int, Spectrum], time: float) -> None:
    small, large = (diffusion_mask(by_colour[side], suit_spot(side), time=time) for side in (256, 512))
    assert (torch.nn.functional.avg_pool2d(large, 2) - small).abs().mean() <= 0.05


def test_a_negative_region_takes_its_likes_out(spectrum) -> None:
    region, other = regions(2).split(1, dim=1)
    plain = diffusion_mask(spectrum, region)
    held = diffusion_mask(spectrum, region, negative=other)
    assert (held <= plain).all()
    assert (held > 0).all()
    near = diffusion_mask(spectrum, other) / plain  # above 1 where a pixel is closer to the negative region
    torch.testing.assert_close(held, plain / (1 + near), atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(diffusion_mask(spectrum, region, negative=region), plain / 2)
    both = diffusion_mask(spectrum, regions(2), negative=other)
    torch.testing.assert_close(both[:, :1], held)
    with pytest.raises(
        ValueError, match=r"negative must have 1 channel or as many as region \(2\), got 3; give one for all"
    ):
        diffusion_mask(spectrum, regions(2), negative=regions(3))
    with pytest.raises(ValueError, match=r"negative must hold a pixel of positive weight in every mask"):
        diffusion_mask(spectrum, region, negative=torch.zeros_like(region))


# --- sliders for every region


def test_masks_are_worked_out_block_by_block(monkeypatch: pytest.MonkeyPatch) -> None:
    guide, weights = noise(2, 1, 20, 30).requires_grad_(), noise(2, 3, 20, 30, seed=1)

    def mask_and_slope() -> tuple[torch.Tensor, torch.Tensor]:
        spectrum = nonlocal_operator(guide, num_landmarks=12, photometric_bandwidth=0.3).spectrum()
        mask = diffusion_mask(spectrum, weights[:, :2], negative=weights[:, 2:])
        return mask, torch.autograd.grad((mask * weights[:, :2]).sum(), guide)[0]

    whole = mask_and_slope()
    monkeypatch.setattr("nlfilter_torch.filtering.masks.CACHED", 1)  # of 256 pixels
    for result, wanted in zip(mask_and_slope(), whole, strict=True):
        torch.testing.assert_close(result, wanted, atol=1e-10, rtol=1e-8)


def test_one_set_of_regions_serves_every_image() -> None:
    spectrum = build(noise(2, 1, SIDE, SIDE), num_landmarks=20).spectrum()
    region, negative = regions(2), regions(2).flip(3)
    both = region.expand(2, -1, -1, -1), negative.expand(2, -1, -1, -1)
    wanted = diffusion_mask(spectrum, both[0], negative=both[1])
    torch.testing.assert_close(diffusion_mask(spectrum, region, negative=both[1]), wanted)
    torch.testing.assert_close(diffusion_mask(spectrum, both[0], negative=negative), wanted)
    torch.testing.assert_close(diffusion_mask(spectrum, region, negative=negative), wanted)
    assert torch.equal(segment_mask(spectrum, region), segment_mask(spectrum, both[0]))


def test_a_region_like_no_landmark_is_worth_a_warning() -> None:
    image, region = noise(1, 1, 32, 32), torch.zeros(1, 2, 32, 32)
    few = nonlocal_operator(image, photometric_bandwidth=0.03, landmarks="uniform").spectrum()
    best = few.factor[0].square().sum(0).argmax()
    region[0, 0].view(-1)[best], region[:, 1, 3, 7] = 1, 1  # a landmark, and a pixel like none
    with pytest.warns(UserWarning, match="region 1 resembles no landmark, so its mask may include"):
        mask = diffusion_mask(few, region)
    assert (mask > 0.5).double().mean((2, 3))[0, 0] < 0.01
    assert (mask > 0.5).double().mean((2, 3))[0, 1] > 0.9
    every = nonlocal_operator(image, photometric_bandwidth=0.03, num_landmarks=1024).spectrum()
    assert (diffusion_mask(every, region) > 0.5).double().mean() < 0.01


def test_sliders_and_masks_learn() -> None:
    masks = noise(2, 2, 3, 4).mul(0.5).requires_grad_()
    alpha = noise(2, 2, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(compose_alpha, (masks, alpha))


@pytest.mark.parametrize("opposed", [False, True])
def test_gradient_of_a_tiny_width_is_finite(opposed: bool) -> None:
    image, region = noise(1, 1, 16, 16).float(), torch.zeros(1, 1, 16, 16)
    region[..., 3:6, 3:6] = 1
    spectrum = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=20).spectrum()
    logarithm = torch.tensor(-60.0, requires_grad=True)
    mask = diffusion_mask(spectrum, region, width=logarithm.exp(), negative=region.flip(3) if opposed else None)
    mask.sum().backward()
    assert mask.isfinite().all()
    assert logarithm.grad is not None
    assert logarithm.grad.isfinite()


def test_the_scale_of_a_region_does_not_count() -> None:
    spectrum = build(noise(1, 1, SIDE, SIDE).float(), num_landmarks=20).spectrum()
    region = regions().double()
    wanted = diffusion_mask(spectrum, region)
    torch.testing.assert_close(diffusion_mask(spectrum, region * 1e60), wanted)
    torch.testing.assert_close(diffusion_mask(spectrum, region.float() * 3e38).double(), wanted, atol=1e-5, rtol=0)


MASKS = [torch.ones(50), torch.ones(1, 1, 1, 1), 1.0, torch.ones(7), [1]]


def test_masks_of_weighted_points_are_checked() -> None:
    for mask in MASKS:
        operator = operator_from_features(
            noise(1, 2, 50), size=(50,), weights=torch.ones(50).double(), num_landmarks=20
        )
        image = noise(1, 1, 1, 50, seed=2)
        with pytest.raises((TypeError, ValueError), match=r"^mask must"):
            fit_alpha(operator, image, image**2, mask=mask)


def test_segments_of_small_total_weight_have_their_own_centres() -> None:
    generator = torch.Generator().manual_seed(0)
    places = [0.2 * torch.randn(20, generator=generator) + centre for centre in (0.0, 1.5, 3.0)]
    features = torch.stack([torch.cat(places), torch.zeros(60)])[None].double()
    weights = torch.tensor([10.0, 1e-3, 10.0]).double().repeat_interleave(20)
    regions = torch.eye(3).repeat_interleave(20, dim=1).view(1, 3, 1, 60).double()
    spectrum = operator_from_features(features, size=(60,), weights=weights, num_landmarks=59).spectrum()
    scaled, rescaled = (
        segment_mask(replace(spectrum, weights=factor * weights[None], scaling=spectrum.scaling), regions)
        for factor in (1.0, 1e4)
    )
    assert torch.equal(scaled, rescaled)
