"""The mask of an object in one photograph, in memory or in tiles, and the file that it is written to."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from nlfilter_torch.core.workers import single_threaded
from nlfilter_torch.photo.cli import editing, options
from nlfilter_torch.photo.cli.editing import rows_by_tiles, rows_in_memory
from nlfilter_torch.photo.cli.jobs import PictureOpener
from nlfilter_torch.photo.cli.processes import zarr_processes
from nlfilter_torch.photo.cli.progress import stages, steps
from nlfilter_torch.photo.cli.scribbles import MarkedPhotograph, Opener, ScribbleOptions
from nlfilter_torch.photo.cli.showing import Scribbled, tell_selected
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.declared.steps import working_bytes
from nlfilter_torch.photo.files.formats import PFM, Depth, check_depth, check_memory, write_pfm
from nlfilter_torch.photo.files.metadata import NO_METADATA
from nlfilter_torch.photo.files.rows import TILED_MEMORY, StoredPicture, check_place, open_picture, write_picture
from nlfilter_torch.photo.files.writing import check_file
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import range_of
from nlfilter_torch.photo.picture.photographs import (
    Photograph,
    check_output,
    depth_in,
    transparent,
    write_photograph,
)
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.regions import region_rows
from nlfilter_torch.photo.picture.source import Fitted, Source, seeded
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.selections.cutouts import Cutout
from nlfilter_torch.photo.selections.mask import RegionMask

PLANE_BYTES = 16  # per pixel, of a mask that is computed in tiles but written at once


@dataclass(frozen=True)
class MaskJob:
    """A mask that is computed from scribbles on a photograph in a file.

    Attributes:
        values: of the options of the parameters, by their names.
        source: the file to read.
        target: the file to write.
        scribbles: options that mark parts of the photograph.
        show: file for the picture of scribbles and mask.
        seed: of the random numbers.
        memory: gigabytes that may be used.
        full: whether statistics of tiles are of all pixels.
        depth: of the file; None is that of its type.
        cutout: file for the object on transparent ground.
    """

    values: Mapping[str, Value]
    source: str
    target: Path
    scribbles: ScribbleOptions
    show: Path | None
    seed: int
    memory: float | None
    full: bool
    depth: options.FileDepth | None
    cutout: Path | None = None

    @property
    def bytes_per_pixel(self) -> int:
        """Memory that the mask needs per pixel of the photograph."""
        landmarks = self.values["landmarks"]
        assert isinstance(landmarks, int)  # for mypy
        return working_bytes(landmarks, 3)

    @property
    def floats(self) -> bool:
        """Whether the mask is written as a PFM file."""
        return self.target.suffix.lower() == PFM

    @property
    def kind(self) -> Depth:
        """Depth of a file that is not PFM."""
        return options.DTYPES[self.depth or ("16" if self.target.suffix.lower() in (".tif", ".tiff") else "8")]

    def check_depth(self) -> None:
        """Raise ValueError if the file cannot have that depth."""
        if self.floats and self.depth not in (None, "float"):
            raise ValueError(
                f"--depth must be float for a .pfm file, got {self.depth}; leave it out, or write a .tif or .png file"
            )

    def run(self, workers: int | None, cluster: str | None) -> None:
        """Compute the mask and write it, in tiles if the photograph does not fit in memory."""
        allowed = editing.allowed_memory(self.memory)
        with steps(3) as begin:
            begin("Reading")
            photograph = editing.read_if_it_fits(self.source, str(self.target), self.bytes_per_pixel, self.memory)
            if photograph is not None:
                mask = Photograph(photograph.pixels[:, :1], self.kind)
                check_file(self.target) if self.floats else check_output(self.target, mask)
                cut = None if self.cutout is None else transparent(photograph, self.cutout)
                if self.cutout is not None and cut is not None:
                    check_output(self.cutout, cut)
                begin("Selecting")
                mask, cut = self._in_memory(photograph, mask, cut, allowed)
                begin("Writing")
                if self.floats:
                    write_pfm(self.target, mask.pixels[0, 0].float().numpy())
                else:
                    write_photograph(mask, self.target)
                if self.cutout is not None and cut is not None:
                    write_photograph(cut, self.cutout)
                return
        with open_picture(Path(self.source), allowed) as picture, ExitStack() as files:
            report = files.enter_context(stages())
            plain = self._check_rows(picture, allowed)
            processes = files.enter_context(zarr_processes(workers, cluster))
            limit = editing.allowed_memory(self.memory, TILED_MEMORY)
            job = editing.Job(picture, self.kind, allowed - picture.cached, limit, report, files, processes)
            self._by_rows(job, plain)

    def _in_memory(
        self, photograph: Photograph, mask: Photograph, cut: Photograph | None, allowed: int
    ) -> tuple[Photograph, Photograph | None]:
        """The mask of a photograph in memory, and its object, if it is to be cut out."""
        rows = rows_in_memory(photograph, self.source)
        with ExitStack() as files:
            marked = self._marked(rows, PictureOpener(files, allowed))
            drawn = marked.tensors()
        image = InMemory(photograph.pixels, weights=photograph.weights)
        fitted = self._fitted(image, drawn)
        if self.cutout is not None:
            cut = transparent(photograph, self.cutout, image.all(cut_out(image, fitted)))
        return mask.with_pixels(image.all(fitted)), cut

    def _check_rows(self, picture: StoredPicture, allowed: int) -> StoredPicture:
        """Check whether the mask can be written, and return the picture that it is written like."""
        check_depth(self.source, picture.rows.dtype)
        plain = replace(picture, rows=region_rows(picture.rows, 0), alpha=False, metadata=NO_METADATA)
        if self.floats:
            check_file(self.target)
            height, width = picture.rows.shape[:2]
            check_memory(Path(self.source), width, height, PLANE_BYTES, allowed)
        else:
            check_place(self.target, self.kind, plain, allowed)
        if self.cutout is not None:
            check_place(
                self.cutout, depth_in(self.cutout, picture.rows.dtype.name), picture.with_transparency(), allowed
            )
        return plain

    def _by_rows(self, job: editing.Job, plain: StoredPicture) -> None:
        """Compute the mask in tiles and write it."""
        tiled = Tiled(Picture(job.picture.marked, self.source), job.passes(self.full, self.target.parent), "--region")
        rows = rows_by_tiles(tiled.picture)
        marked = self._marked(rows, job.open)
        with single_threaded(tiled.passes.workers(1)):
            fitted = self._fitted(tiled, marked.rows())
        if self.floats:
            write_pfm(self.target, tiled.all(fitted)[0, 0].float().numpy())
        else:
            self._write(tiled, fitted, self.target, self.kind, plain)
        if self.cutout is not None:
            depth = depth_in(self.cutout, job.picture.rows.dtype.name)
            self._write(tiled, cut_out(tiled, fitted), self.cutout, depth, job.picture.with_transparency())

    def _write(self, tiled: Tiled, fitted: Fitted, target: Path, depth: str, like: StoredPicture) -> None:
        """Write planes that are computed in tiles."""
        with tiled.tiling(fitted) as tiling:
            planes = replace(tiling, transparent=False, passes=replace(tiling.passes, kind=depth))
            write_picture(target, planes, depth, like, fill=planes.fill)

    def _edit_at(self, size: tuple[int, int], stride: float = 1) -> RegionMask:
        """The settings for a picture (H, W), sampled at every so many pixels of the photograph."""
        arguments = {p.keyword: p.argument_of(self.values[p.name], size, stride) for p in MASK}
        return RegionMask.of(arguments | {"generator": seeded(self.seed)})

    def _marked(self, rows: Rows, opener: Opener) -> MarkedPhotograph:
        """The marks; prints the colours that they cover, and writes the picture of ``--show``."""
        marked = self.scribbles.on(MASK, rows, opener)
        scribbled = Scribbled(marked, rows)
        scribbled.tell_colours()
        if self.show is not None:
            scribbled.show(self.show, self._edit_at)
        return marked

    def _fitted(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the mask, and print how much is selected."""
        working, edit = range_of(source), self._edit_at(source.size)
        seen = source.in_range(working)
        regions = edit.select(seen, drawn)
        tell_selected(regions.selected(seen), opposed="background" in drawn.masks)
        return Fitted(regions.masks, working=working, gives_picture=False)


def cut_out(source: Source[M], fitted: Fitted) -> Fitted:
    """The colours of the object of a mask that was fitted to a picture, and the mask."""
    seen = source.in_range(fitted.working)
    return replace(fitted, pixels=Cutout.of(seen, fitted.pixels, fitted.working))
