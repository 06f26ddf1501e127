"""Edits of pictures larger than memory, in tiles of rows: one step, or a whole edit as saved by the editor."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_photograph
from nlfilter_torch.core.workers import single_threaded
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.declared.steps import Step, acting_steps
from nlfilter_torch.photo.edits.applying import apply_step, fit_step, left_by_crop, scribbles_of
from nlfilter_torch.photo.picture.changes import blend_edited
from nlfilter_torch.photo.picture.developing import develop_planes, limits_of
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.light import develop_image
from nlfilter_torch.photo.picture.painting import RowPainter, TensorPainter
from nlfilter_torch.photo.picture.pictures import Picture, Rows, RowTarget, Tile, mask_of
from nlfilter_torch.photo.picture.sampling import Report, in_silence
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import (
    SAMPLE,
    Passes,
    Statistics,
    Tiling,
    between_steps,
    check_target,
    fill,
    inner,
    tile_by_tile,
)


def edit_rows(passes: Passes, source: RowSource, steps: Sequence[Step], name: str) -> Rows:
    """Yield the rows (h, W, S) of the picture edited as by :meth:`Recipe.apply`, in order; see :func:`edit_tiling`."""
    with edit_tiling(passes, source, steps, name) as tiling:
        yield from tiling


@contextmanager
def edit_tiling(passes: Passes, source: RowSource, steps: Sequence[Step], name: str) -> Iterator[Tiling]:
    """Yield the rows of the picture edited as by :meth:`Recipe.apply`, not yet computed after the last step.

    ``name`` is that of the source, for error messages.

    Raises:
        ValueError: if a step needs the whole picture at once, or does not suit the picture.
        OSError: if a temporary file does not fit.
    """
    steps = acting_steps(steps)
    limits = Picture(source, name).limits if len(steps) > 1 else (0.0, 1.0)
    with ExitStack() as stack:
        for step in steps[:-1]:
            with step_tiling(step, between_steps(passes, source), source, name) as tiling:
                source = stack.enter_context(passes.stored(clipped(tiling, limits)))
        if steps:
            yield stack.enter_context(step_tiling(steps[-1], passes, source, name))
        else:
            yield tile_by_tile(passes, Picture(source, name), inner)


@contextmanager
def edit_regions(
    passes: Passes, source: RowSource, edits: Sequence[Sequence[Step]], masks: Sequence[RowSource], name: str
) -> Iterator[Tiling]:
    """Yield the rows of the picture with an edit of its own in the region of each mask, not yet computed.

    A mask is a grey picture of the same size.

    Raises:
        ValueError, OSError: as :func:`edit_tiling`.
    """
    floats, edited = between_steps(passes, source), []
    with ExitStack() as stack:
        for steps in edits:
            with edit_tiling(floats, source, steps, name) as tiling:
                edited.append(Picture(stack.enter_context(passes.stored(tiling))))
        blend = Blend(edited, [Picture(mask) for mask in masks])
        yield tile_by_tile(passes, Picture(source, name), blend)


@dataclass(frozen=True)
class Blend:
    """A blend of edited pictures, each in the region of its mask."""

    edited: list[Picture]
    masks: list[Picture]

    def __call__(self, tile: Tile) -> Tensor:
        """The blended rows (1, C, h, W) of a tile of the original picture."""
        image, stop = tile.image, tile.start + len(tile.stored)
        edited = [picture.tile(tile.start, stop, 0).image.to(image) for picture in self.edited]
        masks = [mask_of(picture.tile(tile.start, stop, 0)).to(image) for picture in self.masks]
        return blend_edited(image, edited, torch.cat(masks, dim=1))


@contextmanager
def step_tiling(step: Step, passes: Passes, source: RowSource, name: str) -> Iterator[Tiling]:
    """Yield the rows of a picture after a step, not yet computed."""
    tiled = Tiled(Picture(source, name), passes)
    with single_threaded(passes.workers(1)):
        fitted = fit_step(step, tiled, scribbles_of(step, tiled.size, RowPainter()))
    with tiled.tiling(fitted) as tiling:
        yield tiling


def clipped(tiling: Tiling, limits: tuple[float, float]) -> Tiling:
    """The same rows, with values in a range."""
    return replace(tiling, edit=lambda tile: tiling.edit(tile).clamp(*limits))


def stream(
    step: Step,
    source: RowSource,
    target: RowTarget,
    *,
    drawn: Drawn[RowSource] | None = None,
    statistics: Statistics = "sample",
    sample: int = SAMPLE,
    tile_rows: int | None = None,
    memory: int = 1 << 30,
    report: Report | None = None,
    generator: torch.Generator | None = None,
) -> None:
    """Apply a step of any edit to a picture of any size, with only some of its rows in memory at once.

    The whole picture shares landmarks, balancing and coefficients. Given these, the result at a pixel depends only on
    its surroundings, so tiles are exact: there are no seams, and the size of the tiles does not matter.

    Args:
        step: the edit, with its parameters and strokes.
        source: rows (H, W) or (H, W, S) of 8 or 16 bits or floats: a numpy array or memory map, an array of zarr,
            anything that returns rows for a slice. One or three channels are colours; one more is transparency, which
            is copied. Integers are scaled to [0, 1].
        target: receives the rows in order, by assignment to a slice; of the source's shape and any dtype. For edits
            that add colours to a grey picture it has three colours, and transparency if the source has it.
        drawn: scribbles in place of the step's strokes: masks are rows (H, W), (H, W, 1) or, of K regions, (H, W, K)
            in [0, 1]; colours are rows (H, W, 3) in RGB, read under their mask only, or (H, W, 4) with the mask as last
            channel, as is what :func:`recolor` adds by hand.
        statistics: ``"sample"`` balances the filter and computes its coefficients on a sample of the pixels that
            favours rare patches, and reads the source twice; ``"full"`` continues from there with all pixels, in three
            or four passes that each cost more than the output.
        sample: approximate number of pixels of that sample; with as many as the picture has, statistics are full.
        tile_rows: rows of a tile; None is as many as fit in ``memory``. With 256 MB or more, it is rounded to a
            multiple of the rows that make 16,384 pixels.
        memory: bytes that may be used, besides those of source and target.
        report: called with the name of a stage, the part done and the total.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Raises:
        TypeError, ValueError: if an argument or the scribbles do not fit, or the source changes its size while it is
            read.
        MemoryError: if the samples, the scribbled pixels or a single row take more than ``memory``.

    Example:
        >>> picture = np.random.default_rng(0).integers(0, 256, (60, 40, 3), np.uint8)
        >>> edited = np.empty_like(picture)
        >>> stream(Step("detail", alpha=(1.0, 1.0), landmarks=20), picture, edited, tile_rows=16)
        >>> np.array_equal(edited, picture)
        True
    """
    check_target(target, source, coloured=step.declared.coloured)
    passes = Passes(np.dtype(target.dtype).name, statistics, sample, tile_rows, memory, report or in_silence)
    tiled = Tiled(Picture(source), passes)
    drawn = scribbles_of(step, tiled.size, RowPainter()) if drawn is None else drawn
    with single_threaded(tiled.passes.workers(1)):
        fitted = fit_step(step, tiled, drawn, generator=generator)
    fill(target, tiled.rows(fitted))


def apply_recipe(
    recipe: Recipe,
    image: Tensor,
    report: Callable[[int, int], object] | None = None,
    *,
    weights: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Edit a photograph as ``nlfilter-torch apply`` does.

    Args:
        recipe: the steps to apply, after the image is developed.
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        report: called before each step with how many are done, and of how many.
        weights: how much pixels count, (B or 1, 1, H, W) from 0 to 1, such as :attr:`Photograph.weights`; None is 1
            each.
        generator: source of randomness for the landmarks; None draws the same for every step and call.

    Returns:
        (B, C, H, W), with C = 3 if a step added colour, and smaller if the recipe crops or straightens; the image
        itself if nothing has an effect. Values may leave [0, 1]; between steps they are limited to it, or to the range
        of the image if that is larger.
        Differentiable in the image.

    Raises:
        ValueError: if a step cannot be applied to such an image.

    Example:
        >>> from nlfilter_torch.photo import Recipe, Step
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> recipe = Recipe((Step("detail", alpha=(3.0, 1.0)), Step("tone"), Step("detail", alpha=(0.5, 1.0))))
        >>> apply_recipe(recipe, image).shape, apply_recipe(Recipe(), image) is image
        (torch.Size([1, 3, 24, 24]), True)
    """
    if not recipe.develop.is_idle:
        check_photograph(image, "image")
        size = image.shape[-2], image.shape[-1]
        image = develop_image(image, recipe.develop)
        frame = recipe.develop.frame(size)
        recipe = recipe.on_developed(size)
        weights = None if weights is None else develop_planes(weights, frame).clamp(0, 1)
        if weights is not None and not frame.is_whole:
            source, painter = InMemory(image, weights=weights), TensorPainter()
            recipe = Recipe(tuple(left_by_crop(step, source, painter) for step in recipe.steps))
    result, steps = image, recipe.acting
    for done, step in enumerate(steps):
        if report is not None:
            report(done, len(steps))
        before = image if result is image else result.clamp(*limits_of(image))
        result = apply_step(step, before, weights=weights, generator=generator)
    return result
