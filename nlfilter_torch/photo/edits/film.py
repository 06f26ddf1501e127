"""One edit for all frames of a film: fitted to some reference frames, and applied to each frame a few rows at a time.

Everything that an edit computes from the whole picture (landmarks, sums, means, the noise level) it computes from the
reference frames, in an order that does not depend on the picture. The results are cached the first time and returned
again for every other frame, so that equal patches are edited equally in all frames.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Concatenate, ParamSpec, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.blocks import stratified
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.operator.build import operator_from_points
from nlfilter_torch.operator.features import GuideFeatures, estimate_bandwidth, reduce_channels
from nlfilter_torch.operator.landmarks import landmarks_by
from nlfilter_torch.operator.scaling import PixelScaling
from nlfilter_torch.operator.spectrum import RitzPairs
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.declared.steps import Step, acting_steps
from nlfilter_torch.photo.edits.applying import fit_step
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.pixels import WorkingRange
from nlfilter_torch.photo.picture.sampling import CHUNK, ColumnCache, GuidePicture, Pilot
from nlfilter_torch.photo.picture.source import Guide, Planes, Source, seeded
from nlfilter_torch.photo.picture.statistics import Block, Sums
from nlfilter_torch.photo.picture.tiled import Room, Tiled
from nlfilter_torch.photo.picture.tiled_operator import TiledOperator, first_plane
from nlfilter_torch.photo.picture.tiles import Passes

# Pixels of all references together; half or twice as many would be as accurate.
REFERENCE_PIXELS = 1 << 16
UNLIMITED_BANDWIDTH = 1e6  # spatial bandwidth in pixels at which distance has no effect
Cached = TypeVar("Cached")
P = ParamSpec("P")
FrameArray = NDArray[np.float32]


@dataclass(eq=False)
class References:
    """Frames that an edit is fitted to, and the results computed from them so far, in order."""

    pictures: list[Picture]
    results: list[object] = field(default_factory=list)

    def forget_pixels(self) -> None:
        """Free the frames and keep only the results, once all of them are known."""
        self.pictures = []
        for result in self.results:
            if isinstance(result, References):
                result.forget_pixels()
            elif isinstance(result, LearntFilter):
                result.blocks = []


@dataclass(eq=False)
class LearntFilter:
    """The filter of all references: its kernel and balancing, and blocks of the pixels that it was fitted to."""

    pilot: Pilot
    pixel_scaling: PixelScaling
    blocks: list[Block]


class FrameOperator(TiledOperator):
    """The filter of the references, applied to the pixels of a frame."""

    frame: "Frame"

    @property
    def pairs(self) -> RitzPairs:
        """The spectrum."""
        return self.frame.cached_result(self._pairs_of_references)

    def _pairs_of_references(self) -> RitzPairs:
        sums = self._sums_of_references(first_plane, 1)
        return RitzPairs.of_sums(sums.grams[:, :2], self.guide.picture.dtype)

    def sums(self, planes: Planes, order: int) -> Sums:
        """The sums over the references for the first ``order`` powers of W."""
        return self.frame.cached_result(self._sums_of_references, planes, order)

    def _sums_of_references(self, planes: Planes, order: int) -> Sums:
        return self._summed_up(planes, order, self.over("Summing up"))

    def shifted_inner(self, planes: Planes, shifts: Tensor) -> Tensor:
        """The sums over the references for shifted systems."""
        return self.frame.cached_result(self._shifted_of_references, planes, shifts)

    def _shifted_of_references(self, planes: Planes, shifts: Tensor) -> Tensor:
        return self._shifted(planes, shifts, self.over("Summing up"))

    def mean(self, planes: Planes) -> Tensor:
        """Means over the references."""
        return self.frame.cached_result(super().mean, planes)


class Frame(Tiled):
    """A frame as the source of an edit that is fitted to reference frames of the same size."""

    def __init__(self, picture: Picture, passes: Passes, references: References, room: Room | None = None) -> None:
        super().__init__(picture, passes, room=room)
        self.references, self.num_requested = references, 0

    @property
    def memory(self) -> float:
        """None: means are taken over the references, not over what is kept of this frame."""
        return 0.0

    def in_range(self, working: WorkingRange | None) -> "Frame":
        """The frame, with the references, in a range of values."""
        for picture in (self.picture, *self.references.pictures):
            picture.accept_any_scale()
        if working is None:
            return self
        references = self.cached_result(self._references_in_range, working)
        return Frame(self.picture.in_range(working), self.passes, references, self.room)

    def _references_in_range(self, working: WorkingRange) -> References:
        return References([picture.in_range(working) for picture in self.references.pictures])

    def cached_result(self, function: Callable[P, Cached], *args: P.args, **kwargs: P.kwargs) -> Cached:
        """Return the next cached result for the references, or compute it by a function of these, and cache it."""
        if self.num_requested == len(self.references.results):
            with torch.no_grad():
                self.references.results.append(function(*args, **kwargs))
        self.num_requested += 1
        return cast(Cached, self.references.results[self.num_requested - 1])

    def reference_frames(self) -> Iterator["Frame"]:
        """Yield the references, as frames that share the operators of this one."""
        for picture in self.references.pictures:
            yield Frame(picture, self.passes, self.references, self.room)

    @full_precision
    def operator(self, guide: Guide) -> FrameOperator:
        """The filter of the references."""
        learnt = self.cached_result(learn_filter, self.references.pictures, guide)
        operator = FrameOperator(
            GuidePicture(self.picture, guide),
            learnt.pilot,
            self.passes.report,
            sample_size=None,
            full_passes=True,
            kernel=learnt.pilot.kernel,
            bounded=False,
            workers=self.passes.workers(learnt.pilot.moment.shape[1]),
            cache=ColumnCache(1, 0),
        )
        operator.frame, operator._pixel_scaling, operator._sample = self, learnt.pixel_scaling, learnt.blocks
        self.room.operators.append(operator)
        return operator

    def resized(self, size: tuple[int, int]) -> "Frame":
        """The frame, with the references, in a smaller size."""
        references = self.cached_result(self._resized_references, size)
        return Frame(super().resized(size).picture, replace(self.plain, tile_rows=None), references)

    def _resized_references(self, size: tuple[int, int]) -> References:
        return References([Tiled.resized(frame, size).picture for frame in self.reference_frames()])

    def measured(
        self, function: Callable[Concatenate[Source[RowSource], P], Tensor], *args: P.args, **kwargs: P.kwargs
    ) -> Tensor:
        """The mean of a measurement over the references."""
        return self.cached_result(self._average, function, *args, **kwargs)

    def _average(
        self, function: Callable[Concatenate[Source[RowSource], P], Tensor], /, *args: P.args, **kwargs: P.kwargs
    ) -> Tensor:
        """The mean of a function over the references."""
        return average([function(frame, *args, **kwargs) for frame in self.reference_frames()])


def average(values: Sequence[Tensor]) -> Tensor:
    """The mean of tensors of one shape."""
    return torch.stack(list(values)).mean(0)


def learn_filter(pictures: Sequence[Picture], guide: Guide) -> LearntFilter:
    """Fit one filter to several pictures of one size, from an even sample of the pixels of each.

    The coordinates of a pixel are relative to its own picture. The weights of the pixels of all pictures sum to the
    number of pixels of a single picture.
    """
    options = guide.options
    generator = seeded() if options.generator is None else options.generator
    bandwidth = options.bandwidth_or(lambda: average([_bandwidth_of(picture, guide) for picture in pictures]))
    recipe = GuideFeatures.of(options, bandwidth, pictures[0].dtype)
    count = min(pictures[0].pixels, max(1, REFERENCE_PIXELS // len(pictures)))
    drawn = torch.Generator().manual_seed(generator.initial_seed() % (1 << 63))
    features, images = [], []
    for picture in pictures:
        image = whole(picture)
        places = stratified(picture.pixels, count, drawn)
        features.append(recipe(guide(image))[:, :, places])
        images.append(image.flatten(2)[:, :, places])
    points, colours = torch.cat(features, dim=2), torch.cat(images, dim=2)
    weights = torch.full((1, points.shape[2]), pictures[0].pixels / points.shape[2], dtype=points.dtype)
    options = replace(options, num_landmarks=min(options.num_landmarks, points.shape[2]), generator=generator)
    if len(pictures) == 1 and count == pictures[0].pixels and options.landmarks == "kmeans":  # as for any picture
        chosen, _ = landmarks_by(points, pictures[0].size, options, layout=recipe.layout)
        options = replace(options, landmarks=chosen)
    built = operator_from_points(points, (points.shape[2],), options, weights[0])
    pixels = (built.factor, built.diagonal, colours, weights)
    cuts = zip(*(part.split(CHUNK, dim=-1) for part in pixels), strict=True)
    blocks = [Block(factor, diagonal, weight, image=image) for factor, diagonal, image, weight in cuts]
    empty = Block(built.factor[..., :0], built.diagonal[..., :0], weights[..., :0], image=colours[..., :0])
    kernel = replace(built.kernel, features=recipe)
    return LearntFilter(Pilot(kernel, empty, built.balancing.moment, 0), built.balancing, blocks)


def _bandwidth_of(picture: Picture, guide: Guide) -> Tensor:
    """The photometric bandwidth for a picture."""
    compared = reduce_channels(guide(whole(picture)), guide.options.guide_channels)
    return estimate_bandwidth(compared, guide_channels=guide.options.guide_channels)


def whole(picture: Picture) -> Tensor:
    """All pixels (1, C, H, W)."""
    return picture.tile(0, picture.size[0], 0).pixels


def film_steps(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Adapt the steps of an edit to a film: position is ignored unless a spatial bandwidth is set.

    An object that moves far from its position in all references would otherwise be edited differently.

    Raises:
        ValueError: if a step has or needs strokes.
    """
    for step in steps:
        if step.strokes or step.declared.requires_strokes:
            raise ValueError(f"edits of a film must not have strokes, got {step.edit} with strokes; remove that step")
    return tuple(
        step.changed(
            spatial_bandwidth="none" if "none" in step.declared["spatial_bandwidth"].words else UNLIMITED_BANDWIDTH
        )
        if step["spatial_bandwidth"] is None
        else step
        for step in acting_steps(steps)
    )


class FilmEdit:
    """A whole edit, fitted to some frames of a film.

    Args:
        steps: without strokes.
        references: frames (H, W, C) of one size.
        passes: tiling options; ``kind`` is ignored.
        seed: of the random numbers of every step.

    Raises:
        ValueError: if a step has strokes, or references differ in size.
    """

    def __init__(
        self, steps: Sequence[Step], references: Sequence[FrameArray], passes: Passes, *, seed: int = 0
    ) -> None:
        self.steps, self.passes, self.seed = film_steps(steps), replace(passes, kind="float32"), seed
        self.references: list[References] = []
        self.size = references[0].shape[:2]
        pictures = [Picture(reference, "reference") for reference in references]
        for number, step in enumerate(self.steps):
            learnt = References(pictures)
            self.references.append(learnt)
            last = number + 1 == len(self.steps)
            edited = [self.edit(step, picture, learnt) for picture in (pictures[:1] if last else pictures)]
            learnt.forget_pixels()
            pictures = [Picture(rows.clip(0, 1), "reference") for rows in edited]

    def edit(self, step: Step, picture: Picture, references: References) -> FrameArray:
        """Apply a step to a frame (H, W, C)."""
        frame = Frame(picture, self.passes, references)
        rows = frame.rows(fit_step(step, frame, Drawn(), generator=seeded(self.seed)), plain=True)
        return np.concatenate([values for _, values in rows])

    def __call__(self, frame: FrameArray) -> FrameArray:
        """Apply the edit to a frame (H, W, C); values may leave [0, 1]."""
        for step, references in zip(self.steps, self.references, strict=True):
            source = frame if step is self.steps[0] else frame.clip(0, 1)
            frame = self.edit(step, Picture(source, "frame"), references)
        return frame
