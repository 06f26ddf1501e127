"""A whole edit, as saved by the editor, on a picture larger than memory: one step after another, in tiles of rows."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

import torch
from torch import Tensor

from nlfilter_torch.edits.applying import fit_step
from nlfilter_torch.edits.detail import blend_edited
from nlfilter_torch.edits.recipe import Recipe
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.tiled.intermediate import intermediate
from nlfilter_torch.tiled.pictures import Picture, Rows, RowSource, Tile
from nlfilter_torch.tiled.source import Tiled
from nlfilter_torch.tiled.strokes import strokes_by_rows
from nlfilter_torch.tiled.tiles import TILE_PIXELS, Passes
from nlfilter_torch.tiled.workers import single_threaded


def edit_rows(passes: Passes, source: RowSource, recipe: Recipe, name: str) -> Rows:
    """Yield the rows (h, W, S) of the picture edited as by :meth:`Recipe.apply`, in order.

    Args:
        passes: tiling options of every step.
        source: as in :func:`stream_detail`.
        recipe: the edit.
        name: of the source, for error messages.

    Raises:
        ValueError: if a step needs the whole picture at once, or does not suit the picture.
        OSError: if a temporary file does not fit.
    """
    picture = Picture(source, name)
    steps = recipe.acting
    with ExitStack() as stack:
        for step in steps[:-1]:
            rows = step_rows(step, replace(passes, kind="float32"), source, name)
            clipped = ((part, values.clip(0, 1)) for part, values in rows)
            source = stack.enter_context(intermediate(clipped, picture.size, passes.folder))
        if steps:
            yield from step_rows(steps[-1], passes, source, name)
        else:
            yield from passes.apply_in_tiles(
                picture, lambda tile: tile.inner, 0, passes.tile_rows or max(1, TILE_PIXELS // picture.size[1])
            )


def edit_regions(
    passes: Passes, source: RowSource, recipes: Sequence[Recipe], masks: Sequence[RowSource], name: str
) -> Rows:
    """The rows of the picture under one edit for each mask, whose rows are of a grey picture of the same size.

    Raises:
        ValueError, OSError: as :func:`edit_rows`.
    """
    picture = Picture(source, name)
    each = replace(passes, kind="float32")
    with ExitStack() as stack:
        edited = [
            Picture(stack.enter_context(intermediate(edit_rows(each, source, recipe, name), picture.size, each.folder)))
            for recipe in recipes
        ]
        shares = [Picture(mask) for mask in masks]

        def blended(tile: Tile) -> Tensor:
            image, stop = tile.inner, tile.start + tile.inner.shape[2]
            found = [one.tile(tile.start, stop, 0).inner.to(image) for one in edited]
            grey = [reduce_channels(one.tile(tile.start, stop, 0).inner, "luminance").to(image) for one in shares]
            return blend_edited(image, found, torch.cat(grey, dim=1))

        yield from passes.apply_in_tiles(
            picture, blended, 0, passes.tile_rows or max(1, TILE_PIXELS // picture.size[1])
        )


def step_rows(step: Step, passes: Passes, source: RowSource, name: str) -> Rows:
    """Yield the rows of a picture after a step."""
    tiled = Tiled(Picture(source, name), passes)
    with single_threaded(passes.workers(1)):
        fitted = fit_step(step, tiled, *strokes_by_rows(step, tiled.size))
    yield from tiled.rows(fitted)
