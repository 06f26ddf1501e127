"""Diffusion maps and masks: against the dense paper, and what every mask has to be."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch import diffusion_map, diffusion_mask, nonlocal_operator, segment_mask
from tests import reference
from tests.images import photograph, two_colours
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
    found = diffusion_map(spectrum, time=time).flatten(2)[0]
    for pixel in (0, 100, 333):
        np.testing.assert_allclose(
            (found - found[:, pixel : pixel + 1]).square().sum(0),
            reference.diffusion_distance(expected, expected[pixel]),
            rtol=2e-3,
            atol=2e-2,  # of distances up to several hundred
        )


@pytest.mark.parametrize("time", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("width", [1.0, 4.0, 40.0])
def test_mask_is_that_of_the_dense_paper(spectrum, dense, time: float, width: float) -> None:
    s, v = dense
    region = regions(3)
    found = diffusion_mask(spectrum, region, time=time, width=width)
    expected = [reference.diffusion_mask(s, v, r.numpy().ravel(), time, width) for r in region[0]]
    np.testing.assert_allclose(found.flatten(2)[0], np.stack(expected), atol=5e-3)


def test_partition_is_that_of_the_dense_paper(spectrum, dense) -> None:
    region = regions(3)
    found = segment_mask(spectrum, region, time=1.0).flatten(2)[0].numpy()
    expected = reference.segment_mask(*dense, region.flatten(2)[0].numpy(), 1.0, steps=20)
    assert (found == expected).mean() > 0.99


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
    dark, light = mask[..., :20], mask[..., 28:]  # away from the patches that hold both
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
