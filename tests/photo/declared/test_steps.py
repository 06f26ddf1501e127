"""Steps: values, strokes, effect, memory."""

from typing import Any

import pytest
import torch

from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step, working_bytes
from nlfilter_torch.photo.edits.applying import apply_recipe
from tests.recipes import BLUE, COLORIZE, DEFOCUS, DETAIL, IN, RECOLOR, WHOLE


@pytest.mark.parametrize("edit", EDITS)
def test_idle_steps_change_nothing(edit: str, pixels: torch.Tensor) -> None:
    assert not Step.idle(edit).changes()
    assert apply_recipe(Recipe((Step.idle(edit),)), pixels) is pixels
    changed: dict[str, Any] = {"matrix": (0.5,) * 9} if edit == "look" else {}  # the default look changes nothing
    assert Step(edit, (BLUE, IN), **changed).changes()


def test_more_memory_is_asked_for_by_hungrier_steps() -> None:
    assert Recipe().bytes_per_pixel == 0
    assert Recipe((RECOLOR, DEFOCUS, COLORIZE)).bytes_per_pixel == working_bytes(100, 5)
    assert Recipe((DETAIL,)).bytes_per_pixel == working_bytes(DETAIL["landmarks"], 5, factors=2)
    assert Recipe((Step("denoise", method="rule", patch_size=9),)).bytes_per_pixel == working_bytes(200, 9)
    assert WHOLE.bytes_per_pixel == max(step.bytes_per_pixel() for step in WHOLE.acting)
