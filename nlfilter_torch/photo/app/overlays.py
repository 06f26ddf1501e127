"""What the canvas lays over a picture: what the scribbles of a step select, and which parts of them do not count."""

from torch import Tensor

from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import edit_of, scribbles_of
from nlfilter_torch.photo.picture.in_memory import InMemory, edit_image
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.selections.stray import stray_parts


def selected(step: Step, image: Tensor, stride: float = 1) -> Tensor | None:
    """The mask (1, 1, h, w) of what the scribbles of a step select; None if there are none, or it selects nothing.

    ``image`` (1, C, h, w) is the picture before the step, and ``stride`` its sampling step relative to the photograph.
    """
    if not step.painted(step.declared.words[0] if step.declared.words else ""):
        return None
    size = (image.shape[-2], image.shape[-1])
    edit = edit_of(step, size, stride=stride)
    selection = edit.selection()
    if selection is None:
        return None
    return edit_image(selection, image.clamp(0, 1), edit.marks(scribbles_of(step, size, TensorPainter())))


def ignored(step: Step, image: Tensor) -> Tensor | None:
    """Which pixels (1, 1, h, w) under the scribbles of a step do not count, or None; arguments as above."""
    if not step.painted(step.declared.words[0] if step.declared.words else ""):
        return None
    size = (image.shape[-2], image.shape[-1])
    if edit_of(step, size).selection() is None:
        return None
    drawn = scribbles_of(step, size, TensorPainter())
    parts = [stray_parts(InMemory(image.clamp(0, 1)), mask.ceil()) for mask in drawn.masks.values()]
    stray: Tensor = sum(parts[1:], parts[0])
    return stray.clamp(max=1) if bool(stray.any()) else None
