"""The part shared by all commands that edit one photograph: read, check, edit and write, in tiles if necessary."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from os.path import realpath
from pathlib import Path

import torch
from torch import Tensor

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.processes import zarr_processes
from nlfilter_torch.photo.cli.progress import stages, steps
from nlfilter_torch.photo.declared.development import AS_IT_IS, Development
from nlfilter_torch.photo.declared.steps import Step, working_bytes
from nlfilter_torch.photo.files.formats import (
    LOSSY,
    Depth,
    TooLarge,
    check_depth,
    check_memory,
    check_type,
    count_pages,
    type_of,
)
from nlfilter_torch.photo.files.rows import (
    TILED_MEMORY,
    WHOLE_MEMORY,
    StoredPicture,
    check_place,
    is_zarr,
    open_picture,
    usual_memory,
    write_picture,
)
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.light import develop_photograph
from nlfilter_torch.photo.picture.photographs import (
    Photograph,
    check_output,
    read_photograph,
    write_photograph,
    write_photographs,
)
from nlfilter_torch.photo.picture.pictures import Picture, mask_plane
from nlfilter_torch.photo.picture.sampling import Report
from nlfilter_torch.photo.picture.tiles import Passes, Processes, Statistics, Tiling
from nlfilter_torch.photo.picture.viewing import viewed_size

MAP_DEPTH: Depth = "uint16"
ERROR_DEPTH: Depth = "float32"
MOST_GIGABYTES = 1e6  # gigabytes; upper limit of ``--memory``


def allowed_memory(gigabytes: float | None, most: int = sys.maxsize) -> int:
    """``--memory`` in bytes, or without it the usual memory, and at most so many bytes."""
    if gigabytes is None:
        return usual_memory(most)
    if not 0 < gigabytes <= MOST_GIGABYTES:
        raise ValueError(f"--memory must be a positive number of gigabytes, such as 4, got {gigabytes:g}")
    return int(gigabytes * 1e9)


def viewed_within_memory(path: str | Path, size: tuple[int, int], step: Step, factors: int = 1) -> tuple[int, int]:
    """Size (h, w) at which the filter of a step looks at a photograph of size (H, W).

    Raises:
        TooLarge: if so many factors of that size do not fit in the free memory. It is a MemoryError.
    """
    height, width = viewed_size(size, step["viewing_size"])
    check_memory(Path(path), width, height, working_bytes(step["landmarks"], step["patch_size"], factors=factors))
    return height, width


def read_if_it_fits(source: str, target: str, bytes_per_pixel: int, gigabytes: float | None) -> Photograph | None:
    """Read the photograph, or return None if ``--memory`` requires that it is read by rows."""
    if is_zarr(Path(source)) or is_zarr(Path(target)):
        return None
    try:
        return read_photograph(source, bytes_per_pixel=bytes_per_pixel, memory=allowed_memory(gigabytes, WHOLE_MEMORY))
    except TooLarge:
        return None


def read_masks(paths: Sequence[Path], of: str | Path, size: tuple[int, int] | None = None) -> Tensor:
    """Masks (1, K, H, W), see :func:`mask_plane`, of files of the same size, or of the size (H, W)."""
    masks = [mask_plane(read.pixels, read.alpha) for read in map(read_photograph, paths)]
    height, width = masks[0].shape[-2:] if size is None else size
    for path, mask in zip(paths, masks, strict=True):
        if tuple(mask.shape[-2:]) != (height, width):
            like = paths[0] if size is None else of
            raise ValueError(
                f"{path} must have the size of {like}, {width}x{height}, got {mask.shape[-1]}x{mask.shape[-2]}; "
                f"resize it to that of {of}"
            )
    return torch.cat(masks, dim=1)


def check_apart(option: str, path: str | Path | None, **files: str | Path | Iterable[str | Path] | None) -> None:
    """Raise ValueError if the file that an option or argument writes is one of ``files``, named by what they hold."""
    if path is None:
        return
    for what, names in files.items():
        for file in [names] if isinstance(names, str | Path) else names or []:
            if is_same_file(path, file):
                raise ValueError(f"{option} must be another file than the {what}, got {path}; choose another name")


def is_same_file(path: str | Path, other: str | Path) -> bool:
    """Whether two paths lead to the same file, through symbolic or hard links too; neither needs to exist."""
    if realpath(path) == realpath(other):  # Path.resolve fails for links in circles
        return True
    return Path(path).exists() and Path(other).exists() and Path(path).samefile(other)


def check_not_input(source: str, target: str, *, force: bool) -> None:
    """Raise ValueError if the output would replace the photograph, unless the user insists by ``--force``."""
    if not force and is_same_file(source, target):
        raise ValueError(
            f"OUT must be another file than the photograph, got {target}, which the edit would replace; choose another "
            "name, or insist by --force"
        )


def check_quality(target: str, quality: int | None) -> None:
    """Raise ValueError if a quality is set for a file of a type without one."""
    if quality is not None and type_of(target) not in LOSSY:
        raise ValueError(
            f"--quality must be used with a JPEG, WebP or AVIF file, got {quality} for {target}; name a .jpg file, or "
            "leave it out"
        )


def check_quality_of(paths: Sequence[Path], quality: int) -> None:
    """Raise ValueError if a quality is set for a folder of files of which none has a type with one."""
    if not any(type_of(path) in LOSSY for path in paths):
        raise ValueError(
            f"--quality must be used with JPEG, WebP or AVIF files, got {quality} for {paths[0].parent}, which has "
            "none; leave it out"
        )


def check_written(
    source: str,
    target: str,
    *,
    show: Path | None,
    map: Path | None,
    error_map: Path | None,
    mask: Path | None,
    strokes: Path | None,
    preset: str | None,
) -> None:
    """Raise ValueError if a file that a command writes is one that it reads, or its type holds no map."""
    check_apart("OUT", target, mask=mask, strokes=strokes, preset=preset)
    for option, path in (("--show", show), ("--map", map), ("--error-map", error_map)):
        check_apart(option, path, photograph=source, output=target, mask=mask, strokes=strokes, preset=preset)
    check_apart("--error-map", error_map, map=map)
    for path, depth in ((map, MAP_DEPTH), (error_map, ERROR_DEPTH)):
        if path is not None:
            check_type(path, depth, alpha=False)


@dataclass
class Job:
    """A photograph that is edited by rows.

    Attributes:
        picture: the input.
        kind: dtype of the output.
        memory: bytes that may still be used.
        limit: bytes that tiles may use, at most.
        report: called with the progress.
        files: closes opened files.
        processes: compute tiles in place of the threads of this process; None are these threads.
    """

    picture: StoredPicture
    kind: str
    memory: int
    limit: int
    report: Report
    files: ExitStack
    processes: Processes | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.picture.shape[0], self.picture.shape[1]

    def passes(self, full: bool, folder: Path) -> Passes:
        """Tiling options, with statistics from all pixels or from a sample, and a folder for temporary files."""
        statistics: Statistics = "full" if full else "sample"
        memory = max(min(self.memory, self.limit), 1)
        return Passes(self.kind, statistics, memory=memory, report=self.report, folder=folder, processes=self.processes)

    def open(self, path: Path) -> StoredPicture:
        """Open another picture to be read by rows; it is closed at the end of the job."""
        picture = self.files.enter_context(open_picture(path, self.memory))
        check_depth(path, picture.rows.dtype)
        self.memory -= picture.cached
        return picture


def check_workers(workers: int | None, cluster: str | None) -> None:
    """Raise ValueError if processes of this machine and of a cluster are asked for."""
    if workers is not None and cluster is not None:
        raise ValueError(
            f"--workers must not be combined with --cluster, got {workers} and {cluster}; omit one of them"
        )


def check_processes(source: str, target: str, workers: int | None, cluster: str | None) -> None:
    """Raise ValueError if worker processes are asked for and the files are not zarr arrays."""
    check_workers(workers, cluster)
    option = "--workers" if cluster is None else "--cluster"
    if (workers is not None or cluster is not None) and not (is_zarr(Path(source)) and is_zarr(Path(target))):
        raise ValueError(
            f"{option} takes zarr arrays, which several processes can write, as IN and OUT, got {source} and {target}; "
            "leave it out, or convert them"
        )


def rows_by_tiles(picture: Picture) -> Rows:
    """The rows of a picture that is read by rows."""
    return Rows(picture.name, picture.size, picture.colours, lambda rows: picture.tile(rows.start, rows.stop, 0).pixels)


def rows_in_memory(photograph: Photograph, name: str) -> Rows:
    """The rows of a photograph in memory."""
    pixels = photograph.pixels
    return Rows(name, photograph.size, pixels.shape[1], lambda rows: pixels[..., rows, :])


def note_cropped(develop: Development, steps: Iterable[tuple[int, Step]]) -> None:
    """Print a note for each step, with its number, whose strokes of objects are all outside the crop."""
    crop = ",".join(f"{edge:g}" for edge in develop.crop)
    for number, step in steps:
        effect = "its region is left out" if step.declared.regional is not None else "it changes nothing"
        options.note(f"{step.edit}, step {number}, has no strokes within the crop {crop}: {effect}")


@dataclass(frozen=True)
class FileEdit(ABC):
    """An edit of a photograph in a file, in memory or by rows.

    Attributes:
        source: the file to read.
        target: the file to write.
        files: how they are read and written.
        full: whether statistics of tiles are of all pixels.
    """

    source: str
    target: str
    files: options.PhotographOptions
    full: bool

    @property
    @abstractmethod
    def bytes_per_pixel(self) -> int:
        """Memory that the edit needs per pixel of an image."""

    @property
    @abstractmethod
    def coloured(self) -> bool:
        """Whether the edit adds colours to a grey photograph."""

    @property
    def develop(self) -> Development:
        """What comes before the edit."""
        return AS_IT_IS

    def at_size(self, size: tuple[int, int]) -> "FileEdit":
        """The edit of a photograph (H, W), whose crop is known then."""
        return self

    def cropped_away(self, size: tuple[int, int]) -> Iterable[tuple[int, Step]]:
        """The steps, with their numbers, whose objects in a photograph (H, W) are all outside the crop."""
        return ()

    def on_developed(self, size: tuple[int, int]) -> "FileEdit":
        """The edit for a developed photograph that was (H, W) before."""
        return self

    @abstractmethod
    def edited(self, photograph: Photograph) -> Tensor:
        """New pixels (1, C, H, W) of a photograph in memory that is developed already."""

    @abstractmethod
    def tiling(self, job: Job) -> AbstractContextManager[Tiling]:
        """The edited rows of a photograph that does not fit in memory, which are computed within the block."""

    def run(self) -> None:
        """Edit the photograph, and write it to the other file, with its metadata."""
        files, target = self.files, self.target
        check_not_input(self.source, target, force=files.force)
        check_quality(target, files.quality)
        check_processes(self.source, target, files.workers, files.cluster)
        allowed, kind = allowed_memory(files.memory), None if files.depth is None else options.DTYPES[files.depth]
        if files.pages:
            self._run_pages()
            return
        with steps(3) as begin:
            begin("Reading")
            photograph = read_if_it_fits(self.source, target, self.bytes_per_pixel, files.memory)
            if photograph is not None:
                output = self._edited_in_memory(photograph, begin)
                begin("Writing")
                write_photograph(output, target, quality=files.quality)
                return
        with ExitStack() as stack:
            picture = stack.enter_context(open_picture(Path(self.source), allowed))
            own_depth = check_depth(self.source, picture.rows.dtype)  # refuses other dtypes whatever the output is
            stored = kind or own_depth
            edit = self.at_size(picture.shape[:2])
            part = picture.of_part(edit.develop.frame(picture.shape[:2]).size)
            like = part.in_colour() if edit.coloured else part
            check_place(Path(target), stored, like, allowed)
            edit.note_developing(picture.shape[:2], picture.shape[2])
            processes = stack.enter_context(zarr_processes(files.workers, files.cluster))
            limit, report = allowed_memory(files.memory, TILED_MEMORY), stack.enter_context(stages())
            job = Job(picture, stored, allowed - picture.cached, limit, report, stack, processes)
            with edit.tiling(job) as tiling:
                write_picture(Path(target), tiling, stored, like, files.quality, tiling.fill)

    def _edited_in_memory(self, photograph: Photograph, begin: Callable[[str], None], page: str = "") -> Photograph:
        """What is to be written of a photograph; calls ``begin`` before it is edited."""
        size, depth = photograph.size, self.files.depth
        edit = self.at_size(size)
        photograph = develop_photograph(photograph, edit.develop)
        output = photograph if depth is None else replace(photograph, depth=options.DTYPES[depth])
        check_output(self.target, output)
        edit.note_developing(size, photograph.pixels.shape[1])
        begin(f"Editing{page}")
        return output.with_pixels(edit.on_developed(size).edited(photograph))

    def _run_pages(self) -> None:
        """Edit all pages of a TIFF file, and write them as they are edited."""
        source, target = Path(self.source), Path(self.target)
        if type_of(target) != "TIFF" or self.writes_aside:
            got = "one of these" if self.writes_aside else target
            raise ValueError(
                f"--pages must be used with a TIFF file as OUT and without --show, --map and --error-map, got {got}"
            )
        count, memory = 1 if is_zarr(source) else count_pages(source), allowed_memory(self.files.memory)
        with steps(count) as begin:
            pages = (
                self._edited_in_memory(
                    read_photograph(source, bytes_per_pixel=self.bytes_per_pixel, memory=memory, page=number),
                    begin,
                    f" page {number + 1}",
                )
                for number in range(count)
            )
            write_photographs(pages, target, count)

    @property
    def writes_aside(self) -> bool:
        """Whether it writes more pictures than the output."""
        return False

    def note_developing(self, size: tuple[int, int], channels: int) -> None:
        """Print the notes about how a photograph (H, W) with that number of channels is developed."""
        if self.develop.balances and channels < 3:
            options.note(f"{self.source} is grey: white balance changes nothing")
        note_cropped(self.develop, self.cropped_away(size))
