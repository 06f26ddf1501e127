"""What the canvas lays over a picture: what the scribbles of a step select, and which parts of them do not count."""

from dataclasses import replace

from torch import Tensor

from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import edit_of, scribbles_of
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import MARKS, PhotoEdit
from nlfilter_torch.photo.picture.in_memory import InMemory, edit_image
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.selections.stray import stray_parts


class Overlays:
    """Both overlays of a picture; each result is kept, since it is asked for whenever the picture is drawn."""

    def __init__(self) -> None:
        self._selected: tuple[Tensor, Step, Tensor | None] | None = None
        self._ignored: tuple[Tensor, Step, Tensor | None] | None = None

    def selected(self, step: Step, image: Tensor, stride: float = 1) -> Tensor | None:
        """The mask (1, 1, h, w) of what the scribbles of a step select; None if there are none, or all is changed.

        ``image`` (1, C, h, w) is the picture before the step, and ``stride`` its sampling step relative to the
        photograph.
        """
        step = step.mixed(on=True, opacity=1.0)  # the mask does not depend on these
        if self._selected is None or self._selected[0] is not image or self._selected[1] != step:
            self._selected = image, step, _selected(step, image, stride)
        return self._selected[2]

    def ignored(self, step: Step, image: Tensor) -> Tensor | None:
        """Which pixels (1, 1, h, w) under the scribbles of a step do not count, or None."""
        step = step.mixed(on=True, opacity=1.0)
        if self._ignored is None or self._ignored[0] is not image or self._ignored[1] != step:
            self._ignored = image, step, _ignored(step, image)
        return self._ignored[2]


def _selected(step: Step, image: Tensor, stride: float) -> Tensor | None:
    size = (image.shape[-2], image.shape[-1])
    edit = edit_of(step, size, stride=stride)
    selection = edit.selection() if step.marks_object() else None
    if selection is None:
        return None
    return edit_image(selection, image.clamp(0, 1), _marks(step, edit, size))


def _ignored(step: Step, image: Tensor) -> Tensor | None:
    size = (image.shape[-2], image.shape[-1])
    edit = edit_of(step, size)
    if not step.painted_as("object") or edit.selection() is None:
        return None
    masks = _marks(step, edit, size).masks
    names = [name for name in ("scribbles", "background") if name in masks]
    parts = [stray_parts(InMemory(image.clamp(0, 1)), masks[name].amax(1, keepdim=True).ceil()) for name in names]
    stray: Tensor = sum(parts[1:], parts[0])
    return stray.clamp(max=1) if bool(stray.any()) else None


def _marks(step: Step, edit: PhotoEdit, size: tuple[int, int]) -> Drawn[Tensor]:
    """The scribbles of a step, under the names that the edit of its selection takes, without colours."""
    marks = edit.marks(scribbles_of(step, size, TensorPainter()))
    kinds = step.declared.with_role("object", "added")
    coloured = {MARKS[scribble.role] for scribble in kinds if scribble.kind == "colours"}
    return replace(marks, masks={n: mask[:, -1:] if n in coloured else mask for n, mask in marks.masks.items()})
