"""What every verb does that turns one photograph into another: read, check, edit, write."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from nlfilter_torch.cli import options
from nlfilter_torch.cli.progress import steps
from nlfilter_torch.cli.tiled import Job, allowed_memory, edit_by_rows, read_if_it_fits
from nlfilter_torch.core.memory import working_bytes
from nlfilter_torch.io.photographs import Photograph, check_output, read_photograph, write_photograph
from nlfilter_torch.tiled.sources import Rows


def edit_file(
    source: str,
    target: str,
    depth: options.FileDepth | None,
    edit: Callable[[Photograph], Tensor],
    *,
    landmarks: int,
    patch_size: int = 5,
    factors: int = 1,
    memory: float | None = None,
    by_rows: Callable[[Job], Rows] | None = None,
    coloured: bool = False,
) -> None:
    """Write ``edit`` of the photograph in one file to another, at its depth and with all that the file carries.

    Args:
        source: the file to read.
        target: the file to write; may be the same.
        depth: of the output, None for that of the input.
        edit: from the photograph to new pixels (1, C, H, W).
        landmarks: M.
        patch_size: p.
        factors: arrays of the factor's size that the edit holds at once.
        memory: gigabytes that may be used, None for most of what is free; for edits that can do by rows.
        by_rows: the edit of a photograph that is larger, or None where there is no such edit.
        coloured: that the edit by rows gives colours to a grey photograph.
    """
    needed = working_bytes(landmarks, patch_size, factors=factors)
    allowed = None if by_rows is None else allowed_memory(memory)
    with steps(3) as begin:
        begin("Reading")
        if allowed is None:
            photograph: Photograph | None = read_photograph(source, bytes_per_pixel=needed)
        else:
            photograph = read_if_it_fits(source, target, needed, allowed)
        if photograph is not None:
            edited = photograph if depth is None else replace(photograph, depth=options.DEPTHS[depth])
            check_output(target, edited)
            begin("Editing")
            edited = edited.with_pixels(edit(photograph))
            begin("Writing")
            write_photograph(edited, target)
            return
    if allowed is not None and by_rows is not None:
        kind = None if depth is None else options.DEPTHS[depth]
        edit_by_rows(Path(source), Path(target), kind, allowed, by_rows, coloured=coloured)
