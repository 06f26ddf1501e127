"""Folders of photographs: which files they hold, and records of what this program wrote there."""

import contextlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from nlfilter_torch.photo.files.formats import type_of
from nlfilter_torch.photo.files.writing import check_file, check_folder, open_beside

RECORD = ".nlfilter-batch.json"  # in the output folder: the settings of the files there
FRAMES_RECORD = ".nlfilter-frames.json"  # in that of ``frames``: the names of the files that it wrote there


def pictures(folder: Path, what: str = "photographs") -> list[Path]:
    """The image files of a folder, by name, without hidden ones, such as those that macOS adds to every file.

    Raises:
        ValueError: if it is no folder, or has no image files; the message calls them ``what``.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder; give the one that contains the {what}")
    paths = sorted(path for path in folder.iterdir() if is_picture(path))
    if not paths:
        raise ValueError(f"{folder} holds no PNG, JPEG, TIFF, WebP or AVIF file; put the {what} there")
    return paths


def is_picture(path: Path) -> bool:
    """Whether a path is an image file by its suffix, and not hidden."""
    return type_of(path) is not None and not path.name.startswith(".") and path.is_file()


def left_out(folder: Path) -> str:
    """Count the other files of a folder by suffix, such as ``3 .heic``; without hidden ones and settings (.json)."""
    suffixes = Counter(
        path.suffix.lower() or "without a suffix"
        for path in folder.iterdir()
        if path.is_file() and type_of(path) is None and path.suffix.lower() != ".json" and path.name[0] != "."
    )
    return ", ".join(f"{count} {suffix}" for suffix, count in sorted(suffixes.items()))


def subfolders(folder: Path, target: Path) -> list[str]:
    """Names of the folders in a folder, without hidden ones and the folder ``target``."""
    inner = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [path.name for path in inner if path.resolve() != target.resolve()]


def prepare(paths: Sequence[Path], target: Path, settings: Mapping[str, object]) -> None:
    """Create the output folder, or check that an earlier run with the same settings began it.

    Raises:
        ValueError: if ``target`` is the folder of ``paths``, is no folder, or holds files of these names that were made
            with other settings or by another program.
        OSError: if it cannot be written to.
    """
    if target.resolve() == paths[0].parent.resolve():
        raise ValueError(f"{target} must be another folder than that of the photographs; name a new one")
    check_folder(target)
    target.mkdir(exist_ok=True)
    # Look for files first: another rank may be running, which writes the record before its first file.
    present = next((path.name for path in paths if (target / path.name).exists()), None)
    record, text = target / RECORD, json.dumps(settings, indent=2, sort_keys=True) + "\n"
    if record.exists():
        if record.read_text(encoding="utf-8") != text:
            raise ValueError(
                f"{target} contains results of other settings, listed in {record}; name a new folder, or empty this one"
            )
    elif present is not None:
        raise ValueError(_foreign(target, present))
    else:
        with open_beside(record) as stream:
            stream.write(text.encode())


def _foreign(target: Path, name: str) -> str:
    return f"{target} already contains {name}, which this command did not write; name a new folder"


def check_replaced(paths: Sequence[Path], target: Path) -> set[str]:
    """Check that ``frames`` may write files of these names; return the names of those that it wrote there before.

    Raises:
        ValueError: if ``target`` holds files of these names that other programs wrote, or links to ``paths``.
    """
    record, written = target / FRAMES_RECORD, set[str]()
    if record.exists():
        with contextlib.suppress(ValueError, TypeError):  # damaged
            written.update(json.loads(record.read_text(encoding="utf-8")))
    inputs = {path.resolve() for path in paths}
    for path in paths:
        place = target / path.name
        if place.is_symlink() and place.resolve() in inputs:
            raise ValueError(f"{place} is a link to {place.resolve()}, which is one of the frames; name a new folder")
        if place.exists() or place.is_symlink():
            if path.name not in written:
                raise ValueError(_foreign(target, path.name))
            check_file(place)
    return written


def record_written(target: Path, names: set[str]) -> None:
    """Record, for :func:`check_replaced`, the names that ``frames`` writes to a folder."""
    with open_beside(target / FRAMES_RECORD) as stream:
        stream.write((json.dumps(sorted(names), indent=2) + "\n").encode())
