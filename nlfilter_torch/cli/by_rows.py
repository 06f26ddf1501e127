"""``nlfilter-torch detail`` for photographs that fit no memory: tile after tile, from file to file."""

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torch import Tensor

from nlfilter_torch.cli import painting
from nlfilter_torch.cli.progress import stages
from nlfilter_torch.files import Photograph, TooLarge, read_photograph
from nlfilter_torch.streaming.detail import detail_rows
from nlfilter_torch.streaming.files import check_place, free_memory, is_zarr, open_picture, write_picture


def allowed_memory(gigabytes: float | None) -> int:
    """``--memory`` in bytes."""
    if gigabytes is None:
        return free_memory()
    if not 0 < gigabytes < math.inf:
        raise ValueError(f"--memory must be a positive number of gigabytes, such as 4, got {gigabytes:g}")
    return int(gigabytes * 1e9)


def read_if_it_fits(source: str, target: str, bytes_per_pixel: int, memory: int) -> Photograph | None:
    """The photograph, or None if it has to be read by rows."""
    if is_zarr(Path(source)) or is_zarr(Path(target)):
        return None
    try:
        return read_photograph(source, bytes_per_pixel=bytes_per_pixel, memory=memory)
    except TooLarge:
        return None


def edit_by_rows(
    source: Path,
    target: Path,
    alpha: Tensor,
    *,
    depth: str | None,
    mask: Path | None,
    region: list[str] | None,
    memory: int,
    **options: Any,
) -> None:
    """What `detail` does, with the options of :func:`stream_detail`."""
    with ExitStack() as stack:
        picture = stack.enter_context(open_picture(source, memory))
        kind = depth or str(picture.rows.dtype)
        check_place(target, kind, picture, memory)
        size = (picture.shape[0], picture.shape[1])
        stored = None if mask is None else stack.enter_context(open_picture(mask, memory)).rows
        selected = painting.region_rows(size, mask, stored, region, alpha)
        regions, sliders = (None, alpha) if selected is None else selected
        report = stack.enter_context(stages())
        rows = detail_rows(
            picture.rows,
            sliders,
            regions,
            kind=kind,
            memory=max(memory - picture.held, 1),
            report=report,
            name=str(source),
            **options,
        )
        write_picture(target, rows, kind, picture)
