"""One edit for all frames of a film, fitted to reference frames."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.film import UNLIMITED_BANDWIDTH, FilmEdit
from tests.films import PASSES, crop

FEW = {"landmarks": 40}
STEPS = [
    Step("detail", spatial_bandwidth="none", **FEW),
    Step("detail", spatial_bandwidth="none", residual=1.0, channels="all", **FEW),
    Step("detail", spatial_bandwidth=20.0, viewing_size=0.002, **FEW),
    Step("tone", contrast=1.3, clarity=2.0, spatial_bandwidth="none", **FEW),
    Step("sharpen", bandwidth="auto", **FEW),
    Step("denoise", spatial_bandwidth=UNLIMITED_BANDWIDTH, **FEW),
    Step("abstract", edges=0.5, tones=8, spatial_bandwidth=UNLIMITED_BANDWIDTH, **FEW),
    Step("look", alpha=(2.0, 1.5, 1.0), bands=(1.0, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0), spatial_bandwidth="none", **FEW),
]


def edited(step: Step, frame: np.ndarray) -> np.ndarray:
    """A frame under a step, as a photograph."""
    return apply_step(step, torch.from_numpy(frame).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.edit)
def test_fitted_to_one_frame_it_is_the_edit_of_that_frame(step: Step) -> None:
    frame = crop(90, 190)
    filmed, wanted = FilmEdit((step,), [frame], PASSES)(frame), edited(step, frame)
    assert np.abs(wanted - frame).mean() > 0.1 / 255
    np.testing.assert_allclose(filmed, wanted, atol=0.05 / 255)


def test_distance_does_not_count_unless_asked_for() -> None:
    frame = crop(90, 190)
    for edit, far in (("tone", "none"), ("denoise", UNLIMITED_BANDWIDTH)):
        values: dict[str, Any] = {"noise_level": 12.0} if edit == "denoise" else {}
        filmed = FilmEdit((Step(edit, **values, **FEW),), [frame], PASSES)(frame)
        np.testing.assert_allclose(filmed, edited(Step(edit, spatial_bandwidth=far, **values, **FEW), frame), atol=1e-4)


def test_equal_frames_count_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several equal references give the same result as one: balancing, means and noise are averages."""
    monkeypatch.setattr(
        "nlfilter_torch.operator.landmarks.assign_landmarks",
        lambda features, *_, **__: (features[:, :, :1900:48], None),
    )
    frame = crop(90, 190)
    for step in STEPS:
        single, three = (FilmEdit((step,), [frame] * count, PASSES)(frame) for count in (1, 3))
        np.testing.assert_allclose(single, three, atol=0.1 / 255, err_msg=step.edit)


@pytest.mark.parametrize("step", [STEPS[0], STEPS[3]], ids=lambda step: step.edit)
def test_a_pan_does_not_flicker(step: Step) -> None:
    film = [crop(60 + 6 * i, 130 + 6 * i) for i in range(6)]

    def flicker(frames: list[np.ndarray]) -> float:
        return float(np.mean([np.abs(a[6:, 6:] - b[:-6, :-6]).mean() for a, b in pairwise(frames)]))

    assert flicker(film) == 0
    edit = FilmEdit((step,), [film[0], film[5]], PASSES)
    assert flicker([edit(frame) for frame in film]) <= flicker([edited(step, frame) for frame in film]) / 4


def test_steps_follow_each_other() -> None:
    frame, steps = crop(90, 190), (STEPS[3], STEPS[0])
    filmed = FilmEdit(steps, [frame], PASSES)(frame)
    apart = np.abs(filmed - edited(steps[1], edited(steps[0], frame).clip(0, 1)))
    assert apart.mean() < 0.02 / 255
    assert apart.max() < 2 / 255  # candidates for landmarks depend on rounding


def test_strokes_are_refused() -> None:
    stroke = Stroke(((0.5, 0.5),), 0.1, "in")
    for step in (Step("detail", (stroke,)), Step("recolor"), Step("defocus", (stroke,))):
        with pytest.raises(ValueError, match="edits of a film must not have strokes, got"):
            FilmEdit((step,), [crop(0, 0)], PASSES)
