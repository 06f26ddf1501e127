"""Overlays of the canvas: what scribbles select, and which parts of them do not count."""

import torch

from nlfilter_torch.photo.app.overlays import Overlays
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Region, Stroke

TWO = torch.full((1, 3, 60, 90), 0.5) + torch.tensor([0.3, -0.2, -0.2]).view(1, 3, 1, 1)
TWO[..., 48:] = torch.tensor([0.1, 0.5, 0.2]).view(1, 3, 1, 1)
ACROSS = Stroke(((0.22, 0.5), (0.61, 0.5)), 0.02, "#2040e0")  # from the red into the green


def test_results_are_kept_while_picture_and_scribbles_stay() -> None:
    overlays, step = Overlays(), Step("defocus", (ACROSS,))
    first = overlays.ignored(step, TWO)
    assert first is not None
    assert first.nonzero()[:, 3].min() >= 44  # the green begins at 48
    assert overlays.ignored(step.mixed(on=False, opacity=0.3), TWO) is first
    mask = overlays.selected(step, TWO)
    assert mask is not None
    assert overlays.selected(step.mixed(opacity=0.3), TWO) is mask
    assert overlays.ignored(step, torch.full_like(TWO, 0.5)) is None


def test_edits_of_colours_and_of_masks_see_the_same_scribbles() -> None:
    for edit in ("recolor", "defocus", "detail"):
        step = Step(edit, (ACROSS, Region.upright((0.1, 0.1, 0.2, 0.2), "ellipse", "#2040e0")))
        ignored, selected = Overlays().ignored(step, TWO), Overlays().selected(step, TWO)
        assert ignored is not None
        assert ignored[..., 48:].any()
        assert selected is not None
        assert selected.shape == (1, 1, 60, 90)
        assert selected[0, 0, 12, 18] > 0.9
    assert Overlays().selected(Step("tone"), TWO) is None
    assert Overlays().ignored(Step("tone"), TWO) is None
