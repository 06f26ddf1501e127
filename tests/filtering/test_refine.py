"""Refinement of logits and masks: against dense mean-field steps, kinds of input, and bad bandwidths."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from nlfilter_torch import nonlocal_operator, refine
from nlfilter_torch.filtering.refine import FILTER, build_operator
from tests import reference
from tests.images import photograph, two_colours
from tests.pairwise import each_value
from tests.problems import noise, picture

SIZE = (12, 13)
HELD: dict[str, Any] = {"photometric_bandwidth": 0.2, "spatial_bandwidth": 6.0, "landmarks": "uniform"}


def labels(height: int = 48, width: int = 64) -> Tensor:
    """Three areas of different size, (H, W)."""
    truth = torch.zeros(height, width, dtype=torch.long)
    truth[:, width // 2 + 3 :] = 1
    truth[height // 4 : height // 2 + 5, 10:24] = 2
    return truth


def scene() -> tuple[Tensor, Tensor, Tensor]:
    """An image (1, 3, 48, 64) with some noise, true labels (H, W), and logits that are coarse by a factor of 8."""
    truth = labels()
    colours = torch.tensor([[0.2, 0.4, 0.3], [0.7, 0.6, 0.5], [0.4, 0.1, 0.6]])
    image = colours[truth].permute(2, 0, 1)[None] + 0.03 * (noise(1, 3, 48, 64, seed=5).float() - 0.5)
    onehot = torch.nn.functional.one_hot(truth).permute(2, 0, 1)[None].float()
    coarse = torch.nn.functional.avg_pool2d(onehot, 8) + 0.3 * noise(1, 3, 6, 8, seed=6).float()
    return image, truth, torch.nn.functional.interpolate(4 * coarse, (48, 64), mode="bilinear")


def accuracy(result: Tensor, truth: Tensor) -> float:
    return float((result.argmax(1)[0] == truth).double().mean())


def test_steps_are_those_of_the_dense_filter() -> None:
    guide, logits = picture("astronaut", *SIZE), 3 * noise(1, 4, *SIZE, seed=1)
    w = reference.filter_matrix(photograph("astronaut", *SIZE), 5, 0.2)
    expected = reference.mean_field(w, logits[0].flatten(1).T.numpy(), 3.0, 4)
    options: dict[str, Any] = {"patch_size": 5, "num_landmarks": 156, "spatial_bandwidth": None}
    result = refine(
        logits, guide, steps=4, strength=3.0, margin=None, caution=None, photometric_bandwidth=0.2, **options
    )
    np.testing.assert_allclose(result.exp()[0].flatten(1).T.numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_refinement_finds_the_edges(dtype: torch.dtype) -> None:
    image, truth, logits = scene()
    refined = refine(logits.to(dtype), image.to(dtype))
    assert refined.dtype == dtype
    assert accuracy(logits, truth) < 0.975
    assert accuracy(refined, truth) > 0.99


def test_scale_of_logits_does_not_matter() -> None:
    image, _, logits = scene()
    torch.testing.assert_close(refine(30 * logits, image), refine(logits, image), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    ("factor", "name"), each_value([0.1, 0.3, 3.0, 10.0], ["photometric_bandwidth", "spatial_bandwidth", "both"])
)
def test_bad_bandwidths_do_not_make_it_worse(name: str, factor: float) -> None:
    image, truth, logits = scene()
    recipe = build_operator(image, logits.log_softmax(1), None, FILTER).kernel.recipe
    photometric, spatial = recipe.photometric_bandwidth, recipe.spatial_bandwidth
    assert spatial is not None
    refined = refine(
        logits,
        image,
        photometric_bandwidth=photometric * (1.0 if name == "spatial_bandwidth" else factor),
        spatial_bandwidth=float(spatial[0]) * (1.0 if name == "photometric_bandwidth" else factor),
    )
    assert accuracy(refined, truth) >= accuracy(logits, truth) - 0.005


def test_kinds_agree() -> None:
    image, _, logits = scene()
    pair = logits[:, :2]
    probabilities = refine(pair.softmax(1), image, kind="probabilities")
    torch.testing.assert_close(probabilities.sum(1), torch.ones(1, 48, 64))
    expected = probabilities[:, 1:]
    torch.testing.assert_close(refine(pair, image).softmax(1)[:, 1:], expected, atol=1e-3, rtol=1e-3)
    single = refine(pair[:, 1:] - pair[:, :1], image)
    torch.testing.assert_close(single.sigmoid(), expected, atol=1e-3, rtol=1e-3)
    mask = refine(pair.softmax(1)[:, 1:], image, kind="mask")
    torch.testing.assert_close(mask, expected, atol=1e-3, rtol=1e-3)


def test_trimap_keeps_what_is_known_and_finds_the_edge() -> None:
    image = torch.from_numpy(two_colours())[None, None].float()
    truth = (image > image.mean()).float()
    trimap = truth.clone()
    trimap[..., 12:36] = 0.5
    mask = refine(trimap, image, kind="trimap", num_landmarks=100)
    known = trimap != 0.5
    assert torch.equal(mask[known], trimap[known])
    assert bool(((mask > 0.5) == (truth > 0.5)).all())


def test_pixels_without_confidence_do_not_matter() -> None:
    image, truth, logits = scene()
    confidence = torch.ones(1, 1, 48, 64)
    confidence[..., 20:30, 30:44] = 0
    wrong = torch.where(confidence > 0, logits, logits.roll(1, 1) * 5)
    refined = refine(wrong, image, confidence=confidence)
    torch.testing.assert_close(refined, refine(logits, image, confidence=confidence), atol=2e-3, rtol=2e-3)
    assert accuracy(refined, truth) > 0.98


def test_operator_replaces_the_guide() -> None:
    image, _, logits = scene()
    operator = nonlocal_operator(image, patch_size=1, guide_channels="all", **HELD)
    expected = refine(logits, image, num_landmarks=100, **HELD)
    torch.testing.assert_close(refine(logits, operator), expected)


def test_caution_is_for_bandwidths_that_are_passed() -> None:
    image, _, logits = scene()
    torch.testing.assert_close(refine(logits, image), refine(logits, image, caution=None))
    bandwidths: dict[str, Any] = {"photometric_bandwidth": 1.0, "spatial_bandwidth": 30.0}
    torch.testing.assert_close(refine(logits, image, **bandwidths), refine(logits, image, caution=0.2, **bandwidths))
    operator = nonlocal_operator(image, spatial_bandwidth=30.0)
    torch.testing.assert_close(refine(logits, operator), refine(logits, operator, caution=0.2))


def test_identity_is_the_default_compatibility() -> None:
    image, _, logits = scene()
    torch.testing.assert_close(refine(logits, image, compatibility=torch.eye(3)), refine(logits, image))


@pytest.mark.parametrize("name", ["logits", "guide", "strength", "margin", "caution", "compatibility", "confidence"])
def test_gradients(name: str) -> None:
    values = {
        "logits": 2 * noise(1, 3, 5, 4, seed=2),
        "guide": noise(1, 2, 5, 4, seed=3),
        "strength": torch.tensor(3.0, dtype=torch.float64),
        "margin": torch.tensor(2.0, dtype=torch.float64),
        "caution": torch.tensor(0.1, dtype=torch.float64),
        "compatibility": torch.eye(3, dtype=torch.float64) + 0.1,
        "confidence": 0.1 + 0.8 * noise(1, 1, 5, 4, seed=4),
    }

    def call(value: Tensor) -> Tensor:
        arguments: dict[str, Any] = values | {name: value}
        return refine(**arguments, num_landmarks=8, steps=2, **HELD)

    assert gradcheck(call, values[name].requires_grad_())


@given(st.integers(0, 1000), st.sampled_from([1, 2, 4]), st.sampled_from([0.0, 1e-3, 1.0, 1e4]))
def test_results_are_finite_and_classes_are_exchangeable(seed: int, classes: int, scale: float) -> None:
    logits, guide = scale * (noise(1, classes, 9, 8, seed=seed) - 0.5), noise(1, 3, 9, 8, seed=seed + 1)
    options: dict[str, Any] = {"num_landmarks": 20, "landmarks": "uniform"}  # k-means would magnify rounding
    refined = refine(logits, guide, **options)
    assert bool(refined.isfinite().all())
    swapped = refine(logits.flip(1), guide, **options) if classes > 1 else -refine(-logits, guide, **options)
    torch.testing.assert_close(swapped.flip(1), refined, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 8)])
def test_degenerate_images(size: tuple[int, int]) -> None:
    logits, guide = noise(2, 3, *size), torch.full((2, 3, *size), 0.5, dtype=torch.float64)
    assert bool(refine(logits, guide).isfinite().all())
    constant = refine(torch.zeros_like(logits), guide)
    torch.testing.assert_close(constant.exp(), torch.full_like(constant, 1 / 3))


def test_batches() -> None:
    logits, guide = noise(2, 3, *SIZE), noise(2, 3, *SIZE, seed=1)
    both = refine(logits, guide, num_landmarks=30, **HELD)
    for n in range(2):
        single = refine(logits[n : n + 1], guide[n : n + 1], num_landmarks=30, **HELD)
        torch.testing.assert_close(both[n : n + 1], single)
    assert refine(logits[:1], guide, num_landmarks=30).shape == refine(logits, guide[:1], num_landmarks=30).shape
    assert refine(logits[:0], guide[:0]).shape == (0, 3, *SIZE)
