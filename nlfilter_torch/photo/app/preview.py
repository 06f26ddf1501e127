"""A reduced picture under an edit, fast enough to follow a slider.

A photograph is reduced to the viewing size, so that edits of brightness work on exactly the picture that the preview
holds. Only what depends on the full resolution is computed from the photograph itself. Edits that depend on single
pixels differ a little from the saved file, which :meth:`~nlfilter_torch.photo.app.session.Session.at_rest` computes.

Slow results are cached together with the settings they depend on: the layers that the sliders weigh, the filter for
masks, the filter of the step that is being changed, and the picture after each step. While a slider moves, the steps
after its own are applied as they were fitted to the picture before.
"""

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.operator.build import operator_from_points
from nlfilter_torch.operator.features import GuideFeatures, estimate_bandwidth, reduce_channels, unit_window
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import FilterOptions, GuideChannels
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import DETAIL, MASK
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.shared_parameters import VIEWING_SIZE
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import sliders_of
from nlfilter_torch.photo.edits.applying import PreparedStep, edit_of, filter_key, scribbles_of
from nlfilter_torch.photo.picture.changes import (
    DetailChange,
    activity,
    blend_changes,
    change_in_parts,
    change_of_mean,
    limit_by_activity,
)
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import MARKS, PhotoEdit
from nlfilter_torch.photo.picture.in_memory import InMemory, edit_image, fit_edit
from nlfilter_torch.photo.picture.measuring import range_of
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.pixels import Fitted, mixed, part_of
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.source import luminance, seeded
from nlfilter_torch.photo.picture.viewing import MEGAPIXEL, viewed_size, within_limits
from nlfilter_torch.photo.selections.stray import stray_parts

Key = tuple[object, ...]  # the settings on which a cached result depends
PIXELS = round(VIEWING_SIZE.default_number * MEGAPIXEL)  # of a preview, at most


def reduce(image: Tensor, stride: int) -> Tensor:
    """Means over squares of ``stride`` pixels, (B, C, H // stride, W // stride)."""
    return F.avg_pool2d(image, stride) if stride > 1 else image


def operator_of_sample(
    guide: Tensor,
    stride: int,
    detail: Step,
    *,
    bandwidth: float | Tensor,
    distance: float | Tensor | None,
    channels: GuideChannels,
    patch_size: int,
) -> NonlocalOperator:
    """The operator for every ``stride``-th pixel of a guide; patches around these are taken at full resolution."""
    features = GuideFeatures(unit_window(patch_size, None).to(guide), bandwidth, distance, channels)
    size = (guide.shape[-2] // stride, guide.shape[-1] // stride)
    options = FilterOptions(
        num_landmarks=min(detail["landmarks"], size[0] * size[1]), landmarks=detail["sampling"], generator=seeded()
    )
    return operator_from_points(features(guide, stride=stride), size, options)


class AtKnots:
    """An edit of an image that is computed only at the knots of a slider, and interpolated linearly between them.

    It is computed as a whole, and its parts are weighed afterwards.
    """

    def __init__(self, name: str, knots: tuple[float, ...], edit: Callable[[Step], Tensor], image: Tensor) -> None:
        self._name, self._knots, self._edit, self._image = name, knots, edit, image
        self._computed = lru_cache(maxsize=4)(self._compute)

    def __call__(self, step: Step) -> Tensor:
        """The edited image."""
        shares = {name: step[name] for name in step.declared.parts}
        if all(share == 1 for share in shares.values()):
            return self._whole(step)
        whole = step.changed(strokes=None, **dict.fromkeys(shares, 1.0))
        return change_in_parts(self._image, self._whole(whole), **shares)

    def _whole(self, step: Step) -> Tensor:
        """The image under the step, of which all parts count fully."""
        value, knots = step[self._name], self._knots
        if value in knots or value > knots[-1]:
            return self._computed(step)
        above = bisect_right(knots, value)
        low, high = knots[above - 1], knots[above]
        return torch.lerp(self._at(step, low), self._at(step, high), (value - low) / (high - low))

    def _at(self, step: Step, value: float) -> Tensor:
        """The image under the step with another value of the slider."""
        return self._computed(step.changed(strokes=None, **{self._name: value}))

    def _compute(self, step: Step) -> Tensor:
        return self._edit(step) if step.changes() else self._image


def between_knots(declared: Edit, edit: Callable[[Step], Tensor], image: Tensor) -> Callable[[Step], Tensor]:
    """Return an edit of an image that is computed only at the knots of its slider, if that has any."""
    slow = [(p.name, p.slider.knots) for p in declared if p.slider is not None and p.slider.knots]
    return AtKnots(*slow[0], edit, image) if slow else edit


@dataclass(frozen=True, eq=False)
class Layers:
    """Layers (1, k+1, 1, h, w) of the luminance, which the detail sliders weigh, and the eigenvalues (R,)."""

    key: Key
    layers: Tensor
    eigenvalues: Tensor


@dataclass(frozen=True, eq=False)
class StepPicture:
    """The picture after a step at full opacity.

    Attributes:
        key: the steps before it, and the step.
        before: the picture before the step.
        after: the picture after it.
        fitted: the step as fitted to the picture before, or None to add the change that it made to other pictures.
        coloured: whether the colours after the step do not depend on those before it.
    """

    key: tuple[Step, ...]
    before: Tensor
    after: Tensor
    fitted: Fitted | None
    coloured: bool = False

    def of(self, image: Tensor) -> Tensor:
        """Apply the step to another picture of the same size without fitting it again, which is approximate."""
        if image.shape != self.before.shape:
            return image
        if self.coloured:
            luminances = [reduce_channels(picture, "luminance") for picture in (image, self.before)]
            return self.after + (luminances[0] - luminances[1])
        if self.fitted is None:
            return image + (self.after - self.before)
        return InMemory(image.clamp(0, 1)).all(self.fitted)


def selected(step: Step, image: Tensor, stride: float = 1) -> Tensor | None:
    """The mask (1, 1, h, w) of what the scribbles of a step select; None if there are none, or all is changed.

    ``image`` (1, C, h, w) is the picture before the step, and ``stride`` its sampling step relative to the photograph.
    """
    size = (image.shape[-2], image.shape[-1])
    edit = edit_of(step, size, stride=stride)
    selection = edit.selection() if step.marks_object() else None
    if selection is None:
        return None
    return edit_image(selection, image.clamp(0, 1), _marks(step, edit, size))


def ignored(step: Step, image: Tensor) -> Tensor | None:
    """Which pixels (1, 1, h, w) under the scribbles of a step do not count, or None."""
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


def _key_of_layers(detail: Step) -> Key:
    return (*filter_key(detail), detail["viewing_size"], len(detail["alpha"]) - 1)


class Preview:
    """A reduced photograph under any edit.

    Args:
        photograph: (1, C, H, W), in [0, 1] except for files of floats.
        pixels: the largest number of pixels in the preview, approximately.
        reduced: the photograph in the size of the preview, in another light; None is computed.
        light: this change of light, or None.
        reduction: sampling step of the photograph itself, if it is another preview.

    Attributes:
        size: (height, width) of the preview.
        edited: the picture after all steps when it was last complete, or None.
        stride: sampling step of the preview relative to the photograph.
    """

    def __init__(
        self,
        photograph: Tensor,
        pixels: int = PIXELS,
        reduced: Tensor | None = None,
        light: Callable[[Tensor], Tensor] | None = None,
        reduction: float = 1.0,
    ) -> None:
        whole = (photograph.shape[-2], photograph.shape[-1])
        self.size = viewed_size(whole, pixels / MEGAPIXEL)
        self.stride = reduction * math.sqrt(whole[0] * whole[1] / (self.size[0] * self.size[1]))
        self.photograph = photograph
        if reduced is None:
            reduced = resize(photograph.float(), self.size) if self.size != whole else photograph.float()
        self.pixels, self._light = reduced, light
        self.edited: Tensor | None = None
        self._layers: Layers | None = None
        self._layering = Lock()  # layers are computed apart from pictures that need none
        self._working = range_of(InMemory(photograph.float() if light is None else self.pixels))
        self._source = InMemory(self.pixels, {})  # with the filter of the masks
        self._compared_by: Key = ()  # the settings of that filter
        self._masks: tuple[Key, Tensor] | None = None
        self._active: tuple[tuple[int, int], Tensor] | None = None
        self._filter: tuple[Key, Callable[[Step], Tensor]] | None = None
        self._pictures: list[StepPicture] = []
        self._selected, self._ignored = lru_cache(maxsize=1)(selected), lru_cache(maxsize=1)(ignored)

    def has_layers(self, step: Step) -> bool:
        """Whether a first step only weighs layers that are there."""
        layers = self._layers
        return layers is not None and self._is_of_layers(step) and layers.key == _key_of_layers(step)

    def layers(self, detail: Step) -> Layers:
        """The layers for the filter of a step; slow if its settings have changed."""
        order, key = len(detail["alpha"]) - 1, _key_of_layers(detail)
        with self._layering:
            if self._layers is None or self._layers.key != key:
                stride, shown = self._compared(detail)
                guide = reduce_channels(shown, "luminance")
                bandwidth = detail.arguments(self.size)["photometric_bandwidth"]
                operator = operator_of_sample(
                    guide,
                    stride,
                    detail,
                    bandwidth=estimate_bandwidth(guide) if bandwidth == "auto" else bandwidth,
                    distance=self._distance(detail, guide),
                    channels="luminance",
                    patch_size=detail["patch_size"],
                )
                layers = detail_layers(operator, reduce_channels(self.pixels, "luminance"), order=order)
                self._layers = Layers(key, layers, operator.spectrum().eigenvalues[0])
            return self._layers

    def _compared(self, detail: Step) -> tuple[int, Tensor]:
        """The stride of the patches that the filter of a step compares, and their picture, near the viewing size."""
        viewed = self._viewed(detail)
        stride = max(1, round(viewed[0] / self.size[0]))
        if stride == 1:
            return 1, self.pixels
        shown = resize(self.photograph.float(), (self.size[0] * stride, self.size[1] * stride))
        return stride, shown if self._light is None else self._light(shown)

    def _viewed(self, step: Step) -> tuple[int, int]:
        """(H, W) of the photograph at the viewing size of a step."""
        return viewed_size((self.photograph.shape[-2], self.photograph.shape[-1]), step["viewing_size"])

    def _activity(self, detail: Step) -> Tensor:
        """The activity of the picture that the filter of a step compares, at the size of the preview."""
        viewed = self._viewed(detail)
        if self._active is None or self._active[0] != viewed:
            stride, shown = self._compared(detail)
            self._active = (viewed, reduce(activity(shown), stride))
        return self._active[1]

    def _distance(self, detail: Step, guide: Tensor) -> float | Tensor | None:
        """The spatial bandwidth of a step in pixels of a guide."""
        size = (guide.shape[-2], guide.shape[-1])
        scale = self._viewed(detail)[0] / size[0]
        return DETAIL["spatial_bandwidth"].distance(detail.arguments(size, scale)["spatial_bandwidth"], size)

    def masks(self, detail: Step) -> Tensor | None:
        """The masks (1, K, h, w) of the regions, or None without strokes; only the first ones are slow."""
        if not detail.has_region():
            return None
        regions = sliders_of(detail.strokes, detail.sliders_inside)
        marks = detail.painted_as("object", "added")
        numbers = tuple(regions.index(mark.meaning.sliders or detail.sliders_inside) for mark in marks)
        key = (detail.strokes, numbers, detail["reach"], detail["extent"], detail["tolerance"], detail["landmarks"])
        if self._masks is None or self._masks[0] != key:
            fewer = min(detail["landmarks"], MASK.defaults["num_landmarks"])
            if (detail["tolerance"], fewer) != self._compared_by:
                self._source, self._compared_by = InMemory(self.pixels, {}), (detail["tolerance"], fewer)
            edit, drawn = edit_of(detail, self.size), scribbles_of(detail, self.size, TensorPainter())
            selection = edit.selection()
            if selection is None:
                return None
            fitted = fit_edit(selection, self._source, edit.marks(drawn), working=self._working)
            self._masks = (key, self._source.all(fitted))
        return self._masks[1]

    def mask(self, step: Step) -> Tensor | None:
        """The mask (1, 1, h, w) of what the scribbles of a step select, or None."""
        if step.declared.regional is None:
            return self._selected(step.mixed(on=True, opacity=1.0), self.before(step), self.stride)
        masks = self.masks(step)
        return None if masks is None else masks.amax(1, keepdim=True)

    def ignored(self, step: Step) -> Tensor | None:
        """Which pixels (1, 1, h, w) under these scribbles do not count, or None."""
        return self._ignored(step.mixed(on=True, opacity=1.0), self.before(step))

    def before(self, step: Step) -> Tensor:
        """The picture before a step, as it was last rendered, or the reduced photograph."""
        whole = step.mixed(opacity=1.0)
        return next((picture.before for picture in self._pictures if picture.key[-1] == whole), self.pixels)

    def render(self, recipe: Recipe, moving: int | None = None, start: Tensor | None = None) -> Tensor:
        """The preview after all steps, (1, 1 or 3, h, w) in [0, 1].

        While a slider of the step at the place ``moving`` moves, the steps after it are approximate: they are applied
        as fitted to the last complete picture, or make the same change as there, and are left out if there was none.
        ``start`` takes the place of the reduced photograph then.
        """
        result, used, computed = self.pixels if start is None else start, list[StepPicture](), False
        key: tuple[Step, ...] = ()
        for place, step in enumerate(recipe.steps):
            if not step.changes():
                continue
            whole = step.mixed(opacity=1.0)
            if moving is not None and place > moving:
                picture = next((other for other in self._pictures if other.key[-1] == whole), None)
                if picture is not None:
                    used.append(picture)
                    result = mixed(result, picture.of(result), step.opacity)
                continue
            picture = next((other for other in self._pictures if other.key == (*key, whole)), None)
            if picture is None:
                # The first picture that is computed again is that of the step being changed, so its filter is cached.
                picture = self._computed(whole, result, key, keep=not computed)
                computed = computed or bool(key) or not self._is_of_layers(step)
            used.append(picture)
            result, key = mixed(result, picture.after, step.opacity), (*key, step)
        self._pictures, result = used, result.clamp(0, 1)
        if moving is None:
            self.edited = result
        return result

    def prepare(self, recipe: Recipe, step: Step) -> None:
        """Compute the filter of a step that may be changed or added next, after the steps before it in a recipe."""
        if step.declared.requires_strokes:
            return
        with_step = recipe.with_current(step)
        earlier = Recipe(with_step.steps[: with_step.place_of(step.edit)])
        if not earlier.acting and self._is_of_layers(step):
            self.layers(step)
            return
        pictures, edited = self._pictures, self.edited
        image = self.render(earlier)
        self._pictures, self.edited = pictures, edited
        key = tuple(step for step in earlier.steps if step.changes())
        self._filter_of(step.mixed(opacity=1.0), image, key, keep=True)(step)

    def _computed(self, step: Step, image: Tensor, before: tuple[Step, ...], *, keep: bool) -> StepPicture:
        """Apply a step to the picture after the steps before it; ``keep`` says whether to cache its filter."""
        key = (*before, step)
        if not before and self._is_of_layers(step):
            return StepPicture(key, image, self._source.all(self._blend(step)), None)
        edit = self._filter_of(step, image, before, keep=keep)
        after = edit(step)
        # Edits of objects are more exact as fitted, others by their change. Colorize, as fitted, would hold its filter.
        coloured = step.declared.coloured
        is_kept = step.declared.requires_strokes and not coloured
        fitted = edit.fitted if isinstance(edit, PreparedStep) and is_kept else None
        return StepPicture(key, image, after, fitted, coloured)

    def _is_of_layers(self, step: Step) -> bool:
        """Whether a step only weighs layers of luminance, which are cached; such edits take regions, too."""
        if self._working is not None:  # the layers are those of the picture as it is
            return False
        if step.declared.regional is None or step["residual"] is not None or step["channels"] != "luminance":
            return False
        return self._viewed(step) >= self.size

    def _blend(self, detail: Step) -> Fitted:
        """A step that weighs layers."""
        masks, layers = self.masks(detail), part_of(self.layers(detail).layers)
        regions = [] if masks is None else sliders_of(detail.strokes, detail.sliders_inside)
        sliders = torch.tensor([*regions, detail["alpha"]]) - 1
        change = torch.cat([DetailChange(luminance, layers, row)(self._source) for row in sliders], dim=1)
        change = change if masks is None else blend_changes(change, masks)
        limited = limit_by_activity(change, self._activity(detail), detail["threshold"] / 255)
        brighter = detail["alpha"][-1] - 1 if masks is None else change_of_mean(sliders)
        return within_limits(self._source, Fitted(part_of(limited)), detail["limits"], brighter)

    def _filter_of(self, step: Step, image: Tensor, before: Key, *, keep: bool) -> Callable[[Step], Tensor]:
        """A function that applies a step to the picture before it; slow unless its filter is cached."""
        key = (*before, step.edit, *filter_key(step))
        if self._filter is not None and self._filter[0] == key:
            return self._filter[1]
        if keep:
            self._filter = None  # released first, since two filters would take twice the memory
        # A reduced photograph goes a little beyond its range, here as in saving.
        image = image.clamp(0, 1) if before else image
        working = None if before else self._working  # of the photograph, as in saving
        edit = between_knots(step.declared, PreparedStep(image, stride=self.stride, working=working), image)
        if keep:
            self._filter = (key, edit)
        return edit
