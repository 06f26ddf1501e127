"""Applying a step to an image, and caching what later steps of the same kind can reuse."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib import import_module

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.photo.declared.shared_parameters import FILTER_ARGUMENTS
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture.drawn import Drawn, Painter, drawn_by
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import InMemory, fit_edit
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.pixels import M, WorkingRange
from nlfilter_torch.photo.picture.source import Fitted, Source, seeded
from nlfilter_torch.photo.picture.viewing import viewed_size

#: The name of each edit, which is that of its module, and of its class. A new edit takes a line here.
CLASSES = {
    "heal": "Heal",
    "denoise": "Denoise",
    "light": "LightEdit",
    "detail": "Detail",
    "tone": "Tone",
    "sharpen": "Sharpen",
    "colorize": "Colorize",
    "recolor": "Recolor",
    "defocus": "Defocus",
    "abstract": "Abstract",
    "look": "LookEdit",
}


class Edits(Mapping[str, type[PhotoEdit]]):
    """The edits by their names, each imported when it is first asked for: a program needs few of them."""

    def __getitem__(self, name: str) -> type[PhotoEdit]:
        """The class of an edit."""
        edit: type[PhotoEdit] = getattr(import_module(f"nlfilter_torch.photo.edits.{name}"), CLASSES[name])
        return edit

    def __iter__(self) -> Iterator[str]:
        """Their names, in the order of the declaration."""
        return iter(CLASSES)

    def __len__(self) -> int:
        """Their number."""
        return len(CLASSES)


EDIT_OF = Edits()


def scribbles_of(step: Step, size: tuple[int, int], painter: Painter[M]) -> Drawn[M]:
    """Rasterise the strokes of a step over a picture (H, W).

    Raises:
        ValueError: if no pixel is under the strokes that mark the objects, or the edit does not take one of them.
    """
    if not step.is_drawn():
        return Drawn()
    if step.declared.regional is None:
        return drawn_by(step.declared, step.strokes, size, painter)
    drawn = drawn_by(step.declared, step.strokes, size, painter, step.sliders_inside)
    return replace(drawn, outside=torch.tensor(step["alpha"]))


def left_by_crop(step: Step, source: Source[M], painter: Painter[M]) -> Step:
    """A step of a cropped picture, without its strokes if those of its objects cover only pixels that do not count.

    These do as little as strokes outside the crop, see :meth:`Recipe.on_developed`.
    """
    objects = step.objects
    if not objects or any(mark.role == "box" for mark in objects):
        return step
    mask = painter.planes([tuple((mark, True) for mark in objects)], source.size)
    is_seen = not painter.covers(mask) or len(source.scribbles(mask, None, "strokes", needed=False).places) > 0
    return step if is_seen else step.changed(strokes=())


def edit_of(
    step: Step, size: tuple[int, int], *, stride: float = 1, generator: torch.Generator | None = None
) -> PhotoEdit:
    """The edit of a step, with the settings for a picture.

    Args:
        step: step of an edit.
        size: (H, W) of the picture.
        stride: sampling step of the picture relative to the photograph, in pixels along each axis.
        generator: source of randomness; None is that of the command line.
    """
    arguments = step.arguments(size, viewed_stride(step, size, stride))
    return EDIT_OF[step.edit].of(arguments | {"generator": generator or seeded()})


def fit_step(
    step: Step,
    source: Source[M],
    drawn: Drawn[M],
    *,
    stride: float = 1,
    generator: torch.Generator | None = None,
    working: WorkingRange | None = None,
) -> Fitted:
    """Fit a step to a picture, with the given scribbles in place of the step's own; see :func:`scribbles_of`.

    Args:
        step: step of an edit.
        source: the picture.
        drawn: the scribbles.
        stride: sampling step of the source relative to the photograph, in pixels along each axis.
        generator: source of randomness; None is that of the command line.
        working: the range in which the step sees the picture, see :func:`fit_edit`.
    """
    edit = edit_of(step, source.size, stride=stride, generator=generator)
    edit.check_channels(source.channels)
    fitted = fit_edit(edit, source, drawn, working=working)
    return replace(fitted, opacity=step.opacity)


@full_precision
def apply_step(
    step: Step, image: Tensor, *, weights: Tensor | None = None, generator: torch.Generator | None = None
) -> Tensor:
    """Apply a step to an image (B, C, H, W) in [0, 1]; without a generator, with the seed of the command line.

    ``weights`` (B or 1, 1, H, W) say how much pixels count, from 0 to 1; None is 1 each.
    """
    (check_image if EDIT_OF[step.edit].relative else check_photograph)(image, "image")
    source = InMemory(image.to(working_dtype(image)), weights=weights)
    drawn = scribbles_of(step, source.size, TensorPainter())
    return source.all(fit_step(step, source, drawn, generator=generator)).to(image.dtype)


class PreparedStep:
    """Applies steps with equal :func:`filter_key` to an image (1, C, H, W) in [0, 1].

    The filter is computed once, for the first of them, and strokes are rasterised once. ``stride`` is the sampling step
    of the image relative to the photograph, and ``working`` the range in which steps see it, see :func:`fit_edit`.
    ``fitted`` is the step applied last, as fitted to the image.
    """

    def __init__(self, image: Tensor, *, stride: float = 1, working: WorkingRange | None = None) -> None:
        self._source, self._dtype, self._stride = InMemory(image.to(working_dtype(image)), {}), image.dtype, stride
        self._painter, self._working = TensorPainter(), working
        self.fitted: Fitted | None = None

    def __call__(self, step: Step) -> Tensor:
        """Apply a step."""
        drawn = scribbles_of(step, self._source.size, self._painter)
        self.fitted = fit_step(step, self._source, drawn, stride=self._stride, working=self._working)
        return self._source.all(self.fitted).to(self._dtype)


def viewed_stride(step: Step, size: tuple[int, int], stride: float) -> float:
    """Sampling step of a picture (H, W) relative to the size at which the step counts pixels: its viewing size, if any.

    ``stride`` is the sampling step of the picture relative to the photograph.
    """
    if stride == 1 or "viewing_size" not in step.arguments(size):
        return stride
    photograph = (round(size[0] * stride), round(size[1] * stride))
    return stride * viewed_size(photograph, step["viewing_size"])[0] / photograph[0]


def filter_key(step: Step) -> tuple[object, ...]:
    """Values that the filter of a step depends on; steps with equal values share it in :class:`PreparedStep`."""
    return tuple(step[p.name] for p in step.declared if p.keyword in FILTER_ARGUMENTS)
