"""A whole edit, as saved by the editor, on a picture larger than memory: one step after another, in tiles of rows."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nlfilter_torch.core.workers import single_threaded
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.declared.steps import Step, acting_steps
from nlfilter_torch.photo.edits.applying import fit_step, scribbles_of
from nlfilter_torch.photo.picture.changes import blend_edited
from nlfilter_torch.photo.picture.pictures import Picture, Rows, Tile, mask_of
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiled_scribbles import RowPainter
from nlfilter_torch.photo.picture.tiles import Passes, Tiling, between_steps, inner, tile_by_tile


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
