"""Detail of the whole picture and of regions."""

from typing import Any

import pytest
import torch

from nlfilter_torch.photo import adjust_tone, enhance
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.brightness import ALPHA
from tests.problems import BACKGROUND, SUIT, box, colour


def test_small_pictures_have_fewer_landmarks_than_the_default_without_a_warning() -> None:
    image = colour("astronaut", 8, 9)
    for edited in (enhance(image, torch.tensor([2.0, 1.0])), adjust_tone(image, contrast=1.2)):
        assert torch.isfinite(edited).all()


@pytest.mark.parametrize("viewing_size", [0.0, 0.001])
def test_regions_are_checked_at_every_viewing_size(viewing_size: float) -> None:
    image, sliders = colour("astronaut"), torch.tensor([2.0, 1.0])
    for negative in (box(1, 1).numpy(), box(1, 1)[0], box(1, 1).long(), box(1, 1).bool()):
        with pytest.raises((TypeError, ValueError), match=r"^negative must (have|be a torch\.Tensor)"):
            enhance(image, sliders, box(37, 8), negative=negative, viewing_size=viewing_size)


def test_detail_reaches_the_likes_of_a_region_only() -> None:
    image = colour("astronaut")
    sliders = torch.tensor([4.0, 4.0, 4.0, 1.0])
    whole = enhance(image, sliders)
    assert torch.equal(enhance(image, torch.ones(4)), image)
    part = enhance(image, sliders, box(37, 8))
    change, full = (part - image).abs().mean(1), (whole - image).abs().mean(1)
    assert change[0, 36:50, 8:15].mean() > 0.4 * full[0, 36:50, 8:15].mean()
    assert change[0, 2:18, 40:46].mean() < 0.15 * full[0, 2:18, 40:46].mean()
    less = enhance(image, sliders, box(37, 8), negative=box(45, 10))
    assert (less - image).abs()[SUIT].mean() < 0.7 * (part - image).abs()[SUIT].mean()
    with pytest.raises(ValueError, match="negative must hold a painted pixel outside the scribbles of each region"):
        enhance(image, sliders, box(37, 8), negative=box(37, 8))
    two = enhance(
        image, torch.stack([sliders, torch.tensor([0.0, 0.0, 1.0, 1.0])]), torch.cat([box(37, 8), box(4, 42)], 1)
    )
    assert (two - part).abs()[BACKGROUND].max() > 0
    everything = enhance(image, sliders, torch.ones(1, 1, 64, 64))
    assert torch.isfinite(everything).all()
    dot = enhance(image, sliders, box(40, 10, 1, 1))
    share = [((dot - image).abs()[place].mean() / (whole - image).abs()[place].mean()) for place in (SUIT, BACKGROUND)]
    assert share[0] > 3 * share[1]
    with pytest.raises(ValueError, match="negative must be given together with regions, got no regions"):
        enhance(image, sliders, negative=box(1, 1))
    with pytest.raises(ValueError, match=r"alpha must have shape \(1, k\+1\)"):
        enhance(image, torch.ones(2, 4), box(1, 1))


def test_a_threshold_of_zero_in_a_tensor_is_no_threshold() -> None:
    image = torch.full((2, 1, 40, 40), 0.5)
    image[..., 20:] = 0.7
    image[..., 20:, :] += 0.1
    options = {"photometric_bandwidth": 0.2, "num_landmarks": 50, "limits": "none"}
    alpha = torch.tensor([3.0, 3.0, 4.0, 1.0])
    expected = enhance(image, alpha, threshold=0.0, **options)
    torch.testing.assert_close(enhance(image, alpha, threshold=torch.tensor(0.0), **options), expected)
    edited = enhance(image, alpha, threshold=torch.tensor([0.0, 5 / 255]), **options)
    torch.testing.assert_close(edited[:1], expected[:1])


def test_sliders_for_more_images_than_there_are_are_refused() -> None:
    with pytest.raises(ValueError, match=r"alpha must have shape \(k\+1,\), or \(1, k\+1\)"):
        enhance(torch.rand(1, 3, 24, 24), torch.ones(3, 4) * 2)


@pytest.mark.parametrize("residual", [None, 1.0])
def test_sliders_at_1_change_no_bit(residual: float | None) -> None:
    image, region = colour("coffee", 40, 60), torch.zeros(1, 1, 40, 60)
    region[..., 10:20, 10:20] = 1
    for options in ({}, {"viewing_size": 0.001}, {"limits": "none"}, {"threshold": 0.0}):
        edited = enhance(image, torch.ones(4), residual=residual, num_landmarks=40, **options)
        assert torch.equal(edited, image)
        edited = enhance(image, torch.ones(4), region, outside=torch.ones(4), num_landmarks=40, **options)
        assert torch.equal(edited, image)


def test_distance_counts_unless_told_otherwise(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    image = colour("coffee", 48, 72)
    near, explicit, far = (enhance(image, ALPHA, num_landmarks=60, spatial_bandwidth=h) for h in (None, 4.0, "none"))
    assert torch.equal(near, explicit)  # a twelfth of 48
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


@pytest.mark.parametrize("outside", [None, torch.tensor([0.5, 1.0, 1.0])])
def test_what_is_painted_by_hand_is_not_blurred_above_the_viewing_size(outside: torch.Tensor | None) -> None:
    image, shown = colour("astronaut"), {"viewing_size": 0.001, "limits": "none", "num_landmarks": 50}
    sliders = torch.tensor([[4.0, 3.0, 1.0], [0.0, 2.0, 1.0]])
    scribbles, none = torch.cat([box(37, 8), box(4, 42)], dim=1), torch.zeros(1, 1, 64, 64)
    brush, eraser = box(21, 21, 13, 15), box(24, 31, 21, 9)
    added, removed = torch.cat([brush, none], dim=1), torch.cat([none, eraser], dim=1)
    unchanged = image if outside is None else enhance(image, outside, **shown)
    inside = enhance(image, sliders[0], **shown)
    edited = enhance(image, sliders, scribbles, added=added, removed=removed, outside=outside, **shown)
    torch.testing.assert_close(edited * brush, inside * brush, atol=2e-6, rtol=0)
    plain = enhance(image, sliders, scribbles, outside=outside, **shown)
    assert torch.equal(torch.where((brush + eraser) > 0, 0.0, edited), torch.where((brush + eraser) > 0, 0.0, plain))
    erased = enhance(image, sliders, scribbles, added=added, removed=eraser, outside=outside, **shown)
    torch.testing.assert_close(erased * eraser, unchanged * eraser, atol=2e-6, rtol=0)
    half = enhance(image, sliders[0], added=brush / 2, outside=outside, **shown)
    wanted = torch.where(brush > 0, (inside + unchanged) / 2, unchanged)
    torch.testing.assert_close(half, wanted, atol=2e-6, rtol=0)
