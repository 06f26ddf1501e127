"""Edits of pictures in tiles by the arguments of their functions, with scribbles as rows."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from nlfilter_torch.photo import colorize, enhance, recolor, region_mask
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.edits.colorize import Colorize
from nlfilter_torch.photo.edits.detail import Detail
from nlfilter_torch.photo.edits.recolor import Recolor
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.pictures import Picture, RowTarget
from nlfilter_torch.photo.picture.sampling import in_silence
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import SAMPLE, Passes, check_target, fill
from nlfilter_torch.photo.selections.mask import RegionMask

FUNCTIONS: dict[type[PhotoEdit], Callable[..., Tensor]] = {
    Detail: enhance,
    Recolor: recolor,
    Colorize: colorize,
    RegionMask: region_mask,
}


def settings_of(edit: type[PhotoEdit], **settings: Any) -> Any:
    """The edit with the defaults of its function where no other settings are named."""
    parameters = inspect.signature(FUNCTIONS[edit]).parameters
    if unknown := settings.keys() - parameters.keys():
        raise TypeError(f"{FUNCTIONS[edit].__name__} has no arguments {', '.join(sorted(unknown))}")
    defaults = {p.name: p.default for p in parameters.values() if p.default is not inspect.Parameter.empty}
    return edit.of(defaults | settings)


def stream(
    edit: PhotoEdit,
    source: RowSource,
    target: RowTarget,
    drawn: Drawn[RowSource],
    *,
    statistics: Any = "sample",
    sample: int = SAMPLE,
    tile_rows: int | None = None,
    memory: int = 1 << 30,
    report: Any = None,
) -> None:
    """Write the edited rows of a picture to a target."""
    check_target(target, source, coloured=edit.declared.coloured)
    kind = np.dtype(target.dtype).name
    tiled = Tiled(Picture(source), Passes(kind, statistics, sample, tile_rows, memory, report or in_silence))
    edit.check_channels(tiled.channels)
    fill(target, tiled.rows(edit.fit(tiled, drawn)))


PASSES = ("statistics", "sample", "tile_rows", "memory", "report")


def stream_detail(
    source: Any, target: Any, alpha: Tensor, regions: Any = None, *, negative: Any = None, **options: Any
) -> None:
    """Stream :func:`enhance`."""
    passes = {name: options.pop(name) for name in PASSES if name in options}
    masks = {name: mask for name, mask in (("regions", regions), ("negative", negative)) if mask is not None}
    stream(settings_of(Detail, alpha=alpha, **options), source, target, Drawn(masks), **passes)


def stream_recolor(
    source: Any, target: Any, strokes: Any, stroke_mask: Any = None, *, keep: Any = None, **options: Any
) -> None:
    """Stream :func:`recolor`."""
    passes = {name: options.pop(name) for name in PASSES if name in options}
    masks = {name: mask for name, mask in (("stroke_mask", stroke_mask), ("keep", keep)) if mask is not None}
    stream(settings_of(Recolor, **options), source, target, Drawn(masks, strokes), **passes)


def stream_colorize(source: Any, target: Any, strokes: Any, stroke_mask: Any = None, **options: Any) -> None:
    """Stream :func:`colorize`."""
    passes = {name: options.pop(name) for name in PASSES if name in options}
    masks = {} if stroke_mask is None else {"stroke_mask": stroke_mask}
    stream(settings_of(Colorize, **options), source, target, Drawn(masks, strokes), **passes)
