"""Edits from a source to a target of rows."""

from typing import Any

import numpy as np
import pytest
import torch

from nlfilter_torch.photo import Drawn, Step, Stroke, apply_step, stream
from tests.problems import cat as image_of_cat
from tests.recipes import BLUE, COLORIZE, DETAIL, IN, KEEP, RECOLOR, rows_of
from tests.strokes import mask_of, paint
from tests.tiles import FEW, Array, cat, streamed

STEPS = [
    Step("detail", alpha=(2.0, 1.0), landmarks=40),
    DETAIL,
    Step("tone", contrast=1.3, clarity=1.5, landmarks=40),
    Step("sharpen", landmarks=40),
    Step("denoise", noise_level=8.0, landmarks=40),
    RECOLOR,
    COLORIZE,
    Step("defocus", (IN,), landmarks=40, radius=3.0),
    Step("abstract", landmarks=40),
    Step("look", alpha=(2.0, 1.5, 1.0), spatial_bandwidth="none", landmarks=40),
]


def result(step: Step, source: Array, **options: Any) -> Array:
    edited = np.empty((*source.shape[:2], 3), np.float32)
    stream(step, source, edited, **options)
    return edited


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.edit)
def test_a_step_of_any_edit_is_that_in_memory(step: Step) -> None:
    image = image_of_cat(5)
    whole = rows_of(apply_step(step, image))
    edited = result(step, rows_of(image), statistics="full", tile_rows=17)
    assert np.abs(whole - rows_of(image)).max() > 0.01
    assert np.abs(edited - whole).max() < (1e-4 if step == RECOLOR else 2e-5)


def test_scribbles_may_be_rows() -> None:
    """In place of the strokes of the step, whose rasterised form they are here."""
    source, size = rows_of(image_of_cat()), (100, 150)
    colours, mask = (rows_of(planes) for planes in paint([BLUE], size))
    kept = rows_of(mask_of([KEEP], size, above=[BLUE]))
    drawn = Drawn({"stroke_mask": mask, "keep": kept}, colours)
    np.testing.assert_array_equal(result(RECOLOR.changed(strokes=()), source, drawn=drawn), result(RECOLOR, source))
    regions = Drawn({"regions": mask}, sliders=torch.tensor([[3.0, 1.0]]), outside=torch.tensor([0.5, 1.0]))
    detail = Step("detail", (Stroke(BLUE.points, BLUE.radius, "in"),), alpha=(0.5, 1.0), inside=(3.0, 1.0))
    np.testing.assert_array_equal(result(detail.changed(strokes=()), source, drawn=regions), result(detail, source))


def test_strokes_that_cover_nothing_are_named() -> None:
    outside = Step("recolor", (Stroke(((1.8, 1.8),), 0.05, "#2040e0"),))
    with pytest.raises(ValueError, match="strokes of recolor must cover a pixel of the photograph, got none that do"):
        result(outside, cat(40, 50))


def test_only_edits_that_add_colours_take_a_target_in_colour() -> None:
    grey = cat(40, 50)[..., 1]
    assert np.ptp(result(COLORIZE, grey), axis=2).max() > 0.1
    with pytest.raises(ValueError, match="target must have the shape of the source"):
        result(Step("tone"), grey)
    with pytest.raises(ValueError, match="target must have the height and width of the source, three colours"):
        stream(COLORIZE, grey, np.empty_like(grey))
    with pytest.raises(ValueError, match="recolor needs a colour photograph, got a grey one"):
        stream(RECOLOR, grey, np.empty_like(grey))


def test_randomness_comes_from_the_generator() -> None:
    step, source = Step("detail", alpha=(3.0, 1.0), landmarks=20), cat(60, 50)
    first, second, other = (result(step, source, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)
    assert np.array_equal(result(step, source), result(step, source))


def test_report_tells_every_stage_and_its_end() -> None:
    seen: list[tuple[str, int, int]] = []
    streamed(
        cat(40, 60), sample=1000, num_landmarks=20, tile_rows=25, memory=FEW, report=lambda *step: seen.append(step)
    )
    stages = list(dict.fromkeys(stage for stage, _, _ in seen))
    assert stages == ["Looking", "Sampling", "Balancing", "Bounding", "Summing up", "Filtering"]
    assert seen[-3:] == [("Filtering", 0, 40), ("Filtering", 25, 40), ("Filtering", 40, 40)]


REFUSED = [
    (lambda p: p[..., :0], {}, ValueError, r"source must have the shape \(H, W\) or \(H, W, S\)"),
    (lambda p: np.concatenate([p, p], axis=2), {}, ValueError, "one to four channels"),
    (lambda p: p.astype(np.int32), {}, TypeError, "source must hold one of uint8, .* got int32"),
    (lambda p: np.where(p > 0.5, np.nan, p), {}, ValueError, "source holds NaN or infinite pixels"),
    (lambda p: p, {"statistics": "some"}, ValueError, "statistics must be one of"),
    (lambda p: p, {"channels": "red"}, ValueError, "channels must be one of"),
    (lambda p: p, {"sample": 0}, ValueError, "sample must be at least 1"),
    (lambda p: p, {"tile_rows": 0}, ValueError, "tile_rows must be at least 1"),
    (lambda p: p, {"residual": float("nan")}, ValueError, "residual must be finite"),
    (lambda p: p, {"alpha": torch.ones(1, 1, 3)}, ValueError, "alpha must have shape"),
    (lambda p: p, {"num_landmarks": 0}, ValueError, "num_landmarks must be at least 1"),
    (lambda p: p, {"photometric_bandwidth": -1.0}, ValueError, "photometric_bandwidth must be positive"),
    (lambda p: p, {"photometric_bandwidth": "wide"}, ValueError, "photometric_bandwidth must be one of"),
    (lambda p: p, {"spatial_bandwidth": 0.0}, ValueError, "spatial_bandwidth must be positive"),
    (lambda p: p, {"landmarks": "best"}, ValueError, "landmarks must be one of"),
    (lambda p: p, {"completion": "all"}, ValueError, "completion must be one of"),
    (lambda p: p, {"guide_channels": "red"}, ValueError, "guide_channels must be one of"),
    (lambda p: p, {"patch_size": 4}, ValueError, "patch_size must be odd"),
    (lambda p: p, {"tolerance": 1e-3}, TypeError, "tolerance"),
]


def test_what_cannot_be_used_is_named() -> None:
    for change, options, error, message in REFUSED:
        with pytest.raises(error, match=message):
            streamed(change(cat(20, 30)), **options)
