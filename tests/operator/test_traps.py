"""Mistakes that give no error are warned of, with the remedy; correct calls are not."""

import re
import warnings
from typing import Any

import pytest
import torch
from skimage import data
from torch import Tensor

from nlfilter_torch import NonlocalFilter, NonlocalOperator, nonlocal_operator, operator_from_features
from nlfilter_torch.operator.build import operator_from_points
from nlfilter_torch.operator.features import unit_window
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.traps import LARGEST_SHARE, LEAST_POINTS, SAMPLED, sampled_points, share_above
from tests.pairwise import each_value
from tests.problems import noise, seeded

IMAGE = noise(1, 3, 24, 20, dtype=torch.float32)
FEATURES = noise(1, 4, 24, 20, seed=1, dtype=torch.float32)
TRAPS: dict[str, tuple[Tensor, dict[str, Any], str]] = {
    "grey levels": (IMAGE, {"photometric_bandwidth": 20.0}, "photometric_bandwidth must be in units of the guide, wh"),
    "learned": (IMAGE, {"photometric_bandwidth": torch.tensor([20.0])}, "photometric_bandwidth must be in units"),
    "channels last": (IMAGE.permute(0, 2, 3, 1), {}, "guide must have its channels in the second dimension, got"),
    "too large": (10 * FEATURES, {"photometric_bandwidth": 0.2}, "guide must have .* no two pixels are similar"),
    "too small": (FEATURES / 100, {"photometric_bandwidth": 1.0}, "guide must have .* all pixels are alike; lower"),
}


@pytest.mark.parametrize("trap", list(TRAPS))
def test_a_trap_is_warned_of_once_with_the_remedy(trap: str) -> None:
    guide, options, message = TRAPS[trap]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nonlocal_operator(guide, num_landmarks=20, patch_size=1, **options)
    assert len(caught) == 1
    assert re.match(message, str(caught[0].message))
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nonlocal_operator(guide.to("meta"), num_landmarks=20, patch_size=1, **options | {"photometric_bandwidth": 20.0})


CALLS = [
    (IMAGE, {"photometric_bandwidth": 2.0}),
    (IMAGE, {"photometric_bandwidth": 1e4}),
    (255 * IMAGE, {"photometric_bandwidth": 20.0}),
    (torch.full_like(FEATURES, 0.5), {"photometric_bandwidth": 1.0}),
    (FEATURES, {"photometric_bandwidth": 0.3}),
    (FEATURES, {}),
    (noise(1, 24, 20, 8), {}),
    (IMAGE[..., :3], {}),
]


def test_correct_calls_are_silent() -> None:
    for guide, options in CALLS:
        nonlocal_operator(guide, num_landmarks=20, patch_size=1, **options)


def test_the_layer_warns_at_the_line_of_the_user() -> None:
    with pytest.warns(UserWarning, match="divide grey levels by 255") as caught:
        NonlocalFilter(photometric_bandwidth=20.0, num_landmarks=20)(IMAGE)
    assert caught[0].filename == __file__


def clusters(points: int, number: int, dimensions: int, seed: int, wide: float = 0.1, apart: float = 1.0) -> Tensor:
    """Features (1, D, N) of normal clusters."""
    generator = seeded(seed)
    centres = apart * torch.randn(number, dimensions, generator=generator)
    labels = torch.randint(number, (points,), generator=generator)
    return (centres[labels] + wide * torch.randn(points, dimensions, generator=generator)).mT[None].contiguous()


def share_off(operator: NonlocalOperator, features: Tensor, weights: Tensor | None = None) -> float:
    """The share of the points whose rows differ from those of the dense filter by more than half of their weight."""
    x = features[0].mT.double()
    counts = torch.ones(len(x), dtype=torch.float64) if weights is None else weights.double()
    kernel = (-torch.cdist(x, x).square()).exp()
    scaling = torch.ones_like(counts)
    for _ in range(60):
        scaling = (scaling / (kernel @ (counts * scaling))).sqrt()
    rows = scaling[:, None] * kernel * scaling * counts
    off = (operator.to_dense()[0] - rows).abs().sum(1) / 2 > 0.5
    return float((off * counts).sum() / counts.sum())


@pytest.mark.filterwarnings("ignore:landmarks must resemble")
@pytest.mark.parametrize(("completion", "landmarks"), each_value(["diagonal", "none"], [10, 25, 60]))
def test_of_few_points_the_share_is_exact(landmarks: int, completion: str) -> None:
    features = clusters(1500, 50, 16, seed=landmarks)
    weights = 0.5 + torch.rand(1500, generator=seeded(1))
    options: dict[str, Any] = {"size": (1500,), "num_landmarks": landmarks, "completion": completion}
    for counts in (None, weights):
        operator = operator_from_features(features, weights=counts, **options)
        true = share_off(operator, features, counts)
        assert operator.badly_covered().item() == pytest.approx(true, abs=0.01)
        assert landmarks > 50 or true > 0.3 or completion == "none"
        assert landmarks < 50 or true == 0
        assert operator.diagnostics().badly_covered == operator.badly_covered().tolist()


@pytest.mark.filterwarnings("ignore:landmarks must resemble")
@pytest.mark.parametrize(
    ("dimensions", "landmarks", "sampling"),
    [
        (dimensions, landmarks, sampling)
        for (dimensions, landmarks), sampling in each_value(
            [(64, 64), (64, 40), (64, 20), (4, 30), (2, 20)], ["kmeans", "random"]
        )
    ],
)
def test_of_many_points_the_share_is_that_of_the_dense_filter(dimensions: int, landmarks: int, sampling: str) -> None:
    features = clusters(4096, 60, dimensions, seed=9, apart=8 / dimensions**0.5)
    operator = operator_from_features(features, size=(64, 64), num_landmarks=landmarks, landmarks=sampling)  # type: ignore[arg-type]
    true = share_off(operator, features)
    assert operator.badly_covered().item() == pytest.approx(true, abs=0.05)
    assert operator.badly_covered(256).item() == pytest.approx(true, abs=0.12)


def test_points_that_resemble_no_other_are_not_badly_covered() -> None:
    operator = operator_from_features(100 * noise(1, 3, 2000), size=(2000,), num_landmarks=10)
    assert float(share_above(operator.remainder, 0.5, None)) > 0.9
    assert operator.badly_covered().item() < 0.01


def test_it_is_that_of_each_image_and_follows_operators_as_values() -> None:
    features = torch.cat([clusters(1200, 30, 8, 1), clusters(1200, 30, 8, 2, wide=0.5)])
    options: dict[str, Any] = {"size": (30, 40), "num_landmarks": 30}
    both = operator_from_features(features, **options)
    alone = [operator_from_features(image, **options) for image in features.split(1)]
    wanted = torch.cat([operator.badly_covered() for operator in alone])
    for operator in (both, NonlocalOperator.cat(alone), both.detach(), both.to(torch.float64)):
        torch.testing.assert_close(operator.badly_covered(), wanted, atol=1e-3, rtol=0)
    assert both[1].badly_covered().item() == both.badly_covered()[1].item()
    assert both.badly_covered().isfinite().all()


@pytest.mark.filterwarnings("ignore:landmarks must resemble")
def test_points_that_do_not_count_have_no_share() -> None:
    features, weights = clusters(1500, 20, 8, seed=3), torch.ones(1500)
    weights[::3] = 0
    kept = weights > 0
    operator = operator_from_features(features, size=(1500,), weights=weights, num_landmarks=15)
    few = operator_from_features(features[:, :, kept], size=(1000,), num_landmarks=15)
    assert operator.badly_covered().item() == pytest.approx(few.badly_covered().item(), abs=0.01)
    assert operator.badly_covered().item() > 0.1


def test_sampled_places_are_distinct_and_the_same_in_every_call() -> None:
    for points in (1, 2 * SAMPLED, 2 * SAMPLED + 1, 10**6):
        places = sampled_points(points)
        assert len(places.unique()) == len(places) == (points if points <= 2 * SAMPLED else SAMPLED)
        assert places.max() < points
        assert places.equal(sampled_points(points))


@pytest.mark.parametrize(("sampled", "error"), [(0, ValueError), (2.5, TypeError)])
def test_a_wrong_number_of_points_is_refused(sampled: Any, error: type[Exception]) -> None:
    operator = operator_from_features(noise(1, 2, 12), size=(12,), num_landmarks=4)
    with pytest.raises(error, match="sampled must be"):
        operator.badly_covered(sampled)


def test_clusters_without_a_landmark_are_warned_of_once_with_the_remedy() -> None:
    features = clusters(4096, 60, 64, seed=5)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        operator_from_features(features, size=(4096,), num_landmarks=40)
    assert len(caught) == 1
    assert re.match(
        r"landmarks must resemble the points, got 40 of them that leave rows of W of \d+% of the points off by more "
        "than half; use more landmarks, or a larger bandwidth",
        str(caught[0].message),
    )
    assert caught[0].filename == __file__
    operator_from_features(features.to("meta"), size=(4096,), num_landmarks=40)
    operator_from_points(features, (4096,), FilterOptions(num_landmarks=40))
    operator_from_features(features[:, :, : LEAST_POINTS - 1], size=(LEAST_POINTS - 1,), num_landmarks=5)
    operator_from_features(features, size=(4096,), num_landmarks=64)


@pytest.mark.parametrize("name", ["astronaut", "camera", "coffee", "coins", "chelsea", "rocket", "grass", "page"])
def test_photographs_with_the_defaults_are_covered(name: str) -> None:
    picture = torch.from_numpy(getattr(data, name)()).float()[:160, :160] / 255
    guide = picture.permute(2, 0, 1)[None] if picture.ndim == 3 else picture[None, None]
    assert nonlocal_operator(guide).badly_covered().item() < LARGEST_SHARE / 3


def test_long_patches_of_feature_maps_are_warned_of() -> None:
    guide = noise(1, 64, 16, 16, dtype=torch.float32)
    with pytest.warns(UserWarning, match="patch_size must be 1 for guides of many channels, .* 1600 numbers"):
        nonlocal_operator(guide, photometric_bandwidth=0.3, num_landmarks=9)
    for quiet, patch_size in ((guide, 1), (guide[:, :3], 5), (guide[:, :16], 5)):
        nonlocal_operator(quiet, photometric_bandwidth=0.3, num_landmarks=9, patch_size=patch_size)


def test_images_on_the_cpu_are_filtered_under_another_default_device() -> None:
    expected = nonlocal_operator(IMAGE, num_landmarks=9) @ IMAGE
    with torch.device("meta"):
        assert unit_window(5, None).device.type == "cpu"
        found = nonlocal_operator(IMAGE, num_landmarks=9) @ IMAGE
    torch.testing.assert_close(found, expected, atol=0, rtol=0)
