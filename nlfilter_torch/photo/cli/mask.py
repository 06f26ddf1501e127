"""``nlfilter-torch mask``: write a soft mask of an object in a photograph."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import signature
from nlfilter_torch.photo.declared.parameters import MASK

Target = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="The mask: a grey picture of the photograph's size, white in the selected area. Its extension selects the "
        "file type: .tif (16 bits), .png, .jpg, .webp, .avif (8 bits) or .pfm (floats).",
    ),
]
Depth = Annotated[
    options.FileDepth | None,
    typer.Option(
        help="Bits of the mask, or floats (TIFF only): 16 also for .png. Default: see OUT.",
        rich_help_panel=options.FILES_PANEL,
    ),
]
PLANE_BYTES = 16  # per pixel, of a mask that is computed in tiles but written at once
GIVE = "give --region X,Y,W,H or --mask FILE to mark part of the object, such as --region 190,60,60,60"


def mask(
    source: str,
    target: str,
    *,
    region: list[str] | None = None,
    background: list[str] | None = None,
    mask: Path | None = None,
    show: Path | None = None,
    depth: options.FileDepth | None = None,
    seed: int = 0,
    memory: float | None = None,
    full: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    **given: Any,
) -> None:
    """See :data:`MASK`."""
    from nlfilter_torch.photo.cli import editing, scribbles, showing
    from nlfilter_torch.photo.cli.progress import stages, steps
    from nlfilter_torch.photo.declared.steps import working_bytes
    from nlfilter_torch.photo.io.extras import NO_EXTRAS
    from nlfilter_torch.photo.io.pfm import PFM, write_pfm
    from nlfilter_torch.photo.io.photographs import (
        Photograph,
        check_depth,
        check_memory,
        check_output,
        write_photograph,
    )
    from nlfilter_torch.photo.io.rows import TILED, check_place, open_picture, write_picture
    from nlfilter_torch.photo.io.writing import check_file
    from nlfilter_torch.photo.picture.in_memory import InMemory
    from nlfilter_torch.photo.picture.source import Fitted, seeded
    from nlfilter_torch.photo.selections.mask import Regions, select_regions
    from nlfilter_torch.photo.tiled.pictures import Picture
    from nlfilter_torch.photo.tiled.scribbles import region_rows
    from nlfilter_torch.photo.tiled.source import Tiled
    from nlfilter_torch.photo.tiled.workers import single_threaded

    if mask is None and not region:
        raise ValueError(GIVE)
    editing.check_apart("OUT", target, photograph=source, mask=mask)
    editing.check_apart("--show", show, photograph=source, output=target, mask=mask)
    place, floats = Path(target), Path(target).suffix.lower() == PFM
    if floats and depth not in (None, "float"):
        raise ValueError(
            f"--depth must be float for a .pfm file, got {depth}; leave it out, or write a .tif or .png file"
        )
    kind = options.DEPTHS[depth or ("16" if place.suffix.lower() in (".tif", ".tiff") else "8")]
    allowed = editing.allowed_memory(memory)
    editing.check_processes(source, target, workers, cluster)

    def values(size: tuple[int, int], stride: float = 1) -> dict[str, Any]:
        return {p.keyword: p.argument_of(given[p.name], size, stride) for p in MASK}

    def arguments(size: tuple[int, int]) -> dict[str, Any]:
        return values(size) | {"generator": seeded(seed)}

    def selected_by(size: tuple[int, int], read: scribbles.Open) -> tuple[Any, Any]:
        """Foreground and background scribbles."""
        inside = scribbles.selection(size, mask, region, "--region", read)
        return inside, scribbles.selection(size, None, background, "--background", read)

    def tell(drawn: tuple[Any, Any], size: tuple[int, int], read: showing.Read) -> None:
        """Print the colours that scribbles cover, and write the picture of ``--show``."""
        scribbled = (drawn[:1], {"background": drawn[1]})
        showing.tell_colours(showing.overlays(scribbled), read)
        if show is not None:
            showing.show(show, "mask", values, size, read, scribbled)

    def told(regions: Regions) -> Fitted:
        """Print how much is selected."""
        showing.tell_selected(regions.reduced_masks(), background)
        return Fitted(regions.masks)

    with steps(3) as begin:
        begin("Reading")
        photograph = editing.read_if_it_fits(source, target, working_bytes(given["landmarks"], 3), memory)
        if photograph is not None:
            selected = Photograph(photograph.pixels[:, :1], kind)
            check_file(place) if floats else check_output(place, selected)
            begin("Selecting")
            with ExitStack() as files:
                drawn = selected_by(photograph.size, lambda path: files.enter_context(open_picture(path, allowed)))
                tell(drawn, photograph.size, lambda rows: photograph.pixels[..., rows, :])
                inside, outside = (None if rows is None else rows.at_once() for rows in drawn)
            assert inside is not None  # for mypy
            whole = InMemory(photograph.pixels)
            found = whole.all(told(select_regions(whole, inside, outside, **arguments(photograph.size))))
            begin("Writing")
            if floats:
                write_pfm(place, found[0, 0].float().numpy())
            else:
                write_photograph(selected.with_pixels(found), place)
            return
    with open_picture(Path(source), allowed) as picture, stages() as report:
        check_depth(source, picture.rows.dtype)
        plain = replace(picture, rows=region_rows(picture.rows, 0), alpha=False, icc=None, exif=None, extras=NO_EXTRAS)
        if floats:
            check_file(place)
            height, width = picture.rows.shape[:2]
            check_memory(Path(source), width, height, PLANE_BYTES, allowed)
        else:
            check_place(place, kind, plain, allowed)
        with ExitStack() as files:
            processes = editing.processes_for(workers, cluster, files)
            limit = editing.allowed_memory(memory, TILED)
            job = editing.Job(picture, kind, allowed - picture.cached, limit, report, files, processes)
            tiled = Tiled(Picture(picture.rows, source), job.passes(full, place.parent), "--region")
            drawn = selected_by(job.size, job.open)
            tell(drawn, job.size, lambda rows: tiled.picture.tile(rows.start, rows.stop, 0).pixels)
            with single_threaded(tiled.passes.workers(1)):
                fitted = told(select_regions(tiled, *drawn, **arguments(job.size)))
            if floats:
                write_pfm(place, tiled.all(fitted)[0, 0].float().numpy())
                return
            with tiled.tiling(fitted) as tiling:
                write_picture(place, replace(tiling, transparent=False), kind, plain)


mask.__doc__ = MASK.help
mask.__signature__ = signature(MASK, target=Target, depth=Depth)  # type: ignore[attr-defined]  # read by typer
mask.__annotations__ = {}
