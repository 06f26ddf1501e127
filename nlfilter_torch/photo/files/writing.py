"""Files that appear under their name only when they are complete, and checks of where they are to be written.

Also rows in temporary files, which take space on the disk rather than memory.
"""

import math
import os
import re
import secrets
import shutil
import sys
import tempfile
import time
from collections.abc import Container, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np

from nlfilter_torch.photo.declared.rows import Stored

if sys.platform != "win32":
    import fcntl

PART = re.compile(r"\..+\.[0-9a-f]{8}\.part", re.DOTALL)  # names made by name_beside
LONGEST_STEM = 240  # bytes of the file's own name in these
unfinished: set[Path] = set()  # files being written; read by the command line when interrupted


def check_file(path: str | Path) -> None:
    """Raise ValueError unless a file can be created at ``path``."""
    path = link_target(path)
    if path.is_symlink():
        raise ValueError(f"{path} is a symbolic link that leads back to itself; choose another name")
    if path.is_dir():
        raise ValueError(f"{path} is a folder; add a file name to it")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is a pipe, a socket or a device, not a file; choose another name")
    _check_parent(path)
    if path.exists() and not os.access(path, os.W_OK):
        raise ValueError(f"{path} is read-only; allow writing to it, or choose another name")


def check_folder(folder: str | Path) -> None:
    """Raise ValueError unless ``folder`` is writable or can be created."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, not a folder; choose a folder for the output")
    _check_parent(folder / "file" if folder.exists() else folder)


def _check_parent(path: Path) -> None:
    if not path.parent.is_dir():
        raise ValueError(f"{path} cannot be written because the folder {path.parent} does not exist; make it first")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path} cannot be written because the folder {path.parent} is read-only; choose another")


@contextmanager
def open_beside(path: str | Path) -> Iterator[BinaryIO]:
    """Open a binary file that is renamed to ``path`` when the block succeeds, and removed when it fails.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with open_beside(folder / "note.txt") as stream:
    ...     _ = stream.write(b"whole")
    >>> [file.name for file in folder.iterdir()]
    ['note.txt']
    """
    with file_beside(link_target(path)) as beside, beside.open("r+b") as stream:
        yield stream


@contextmanager
def file_beside(path: Path) -> Iterator[Path]:
    """Make an empty file that is renamed to ``path``, which is no link, when the block succeeds, else removed.

    It gets the permissions of the file that it replaces, and until then none but its owner can read it.
    """
    with part_beside(path) as beside:
        beside.touch(mode=0o600 if path.exists() else 0o666, exist_ok=False)
        with claimed(beside):
            yield beside
            if path.exists():
                shutil.copymode(path, beside)
            beside.replace(path)


def copy_modes(folder: Path, target: Path, like: Path) -> None:
    """Give a folder, and what is in it, the permissions of another one, and of a file ``like`` in that."""
    for part in (target, *target.rglob("*")):
        shutil.copymode(folder if part.is_dir() else like, part)


@contextmanager
def part_beside(path: Path) -> Iterator[Path]:
    """Reserve a unique hidden name beside ``path`` for a file or folder, which is removed when the block ends."""
    # Not tempfile: the file needs the usual permissions and must be on the same file system.
    beside = name_beside(path)
    unfinished.add(beside)
    try:
        remove_stale(path.parent, {path.name})
        yield beside
    except OSError as error:
        if error.errno is None or not str(error.filename or beside).startswith(str(beside)):
            raise
        # A full disk, a quota or missing permission: the system's message does not name the path.
        raise OSError(
            f"{path} cannot be written: {error.strerror}; free some space there or write elsewhere"
        ) from error
    finally:
        _remove(beside)
        unfinished.discard(beside)


def link_target(path: str | Path) -> Path:
    """Return ``path``, or its target if it is a symbolic link."""
    path = Path(path)
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def name_beside(path: Path) -> Path:
    """Return a unique hidden name in the same folder for a file that is being written.

    It fits in the 255 bytes that file systems allow: a longer name is shortened. What a killed process leaves under a
    shortened name is not removed.
    """
    name, encoded = path.name, os.fsencode(path.name)
    if len(encoded) > LONGEST_STEM:
        name = encoded[:LONGEST_STEM].decode(errors="ignore")
    return path.with_name(f".{name}.{secrets.token_hex(4)}.part")


@contextmanager
def claimed(part: Path) -> Iterator[None]:
    """Lock a file or folder, so that :func:`remove_stale` in other processes does not remove it."""
    with ExitStack() as stack:
        if sys.platform != "win32":  # open files cannot be removed there
            stack.callback(os.close, handle := os.open(part, os.O_RDONLY))
            with suppress(OSError):  # a file system without locks
                fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def _is_claimed(part: Path) -> bool:
    if sys.platform == "win32":
        return False
    with suppress(OSError), ExitStack() as stack:
        stack.callback(os.close, handle := os.open(part, os.O_RDONLY))
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return False
    return True


def remove_stale(folder: Path, names: Container[str]) -> None:
    """Remove unfinished files of killed processes in a folder; ``names`` are the names of the finished files."""
    for part in folder.glob(".*.part"):
        if PART.fullmatch(part.name) and part.name[1:].rsplit(".", 2)[0] in names and not _is_claimed(part):
            _remove(part)


def _remove(part: Path) -> None:
    with suppress(OSError):  # no such file, or the name is too long
        if part.is_dir():
            for pause in (0.0, 0.1, 0.4):  # after an interrupt, a zarr thread may still be writing its last chunk
                time.sleep(pause)
                shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink()


@dataclass(frozen=True)
class FileRows:
    """Rows in an open file, which are read when they are needed.

    They are not mapped into memory: the system counts what was read of a mapped file as memory of the process.

    Attributes:
        stream: the file, which holds nothing else.
        shape: (H, W) or (H, W, S).
        dtype: of the rows.
        lock: held while the place in the file matters.
    """

    stream: BinaryIO
    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    lock: Lock = field(default_factory=Lock)

    def __getitem__(self, rows: slice) -> Stored:
        """The rows from ``rows.start`` to ``rows.stop``."""
        start, stop, _ = rows.indices(self.shape[0])
        length = math.prod(self.shape[1:]) * self.dtype.itemsize
        with self.lock:
            self.stream.seek(start * length)
            data = self.stream.read((stop - start) * length)
        return np.frombuffer(data, self.dtype).reshape(-1, *self.shape[1:])

    def part(self, rows: range, columns: range) -> Stored:
        """Some rows and columns (h, w, S) of (H, W, S), without reading the others."""
        pixel = math.prod(self.shape[2:]) * self.dtype.itemsize
        data = bytearray()
        with self.lock:
            for row in rows:
                self.stream.seek((row * self.shape[1] + columns.start) * pixel)
                data += self.stream.read(len(columns) * pixel)
        return np.frombuffer(data, self.dtype).reshape(len(rows), len(columns), *self.shape[2:])

    @contextmanager
    def array(self) -> Iterator[Stored]:
        """The file as an array to write to, which is not in memory after the block."""
        yield np.memmap(self.stream, dtype=self.dtype, mode="r+", shape=self.shape)


def temporary_rows(shape: tuple[int, ...], dtype: np.dtype[np.generic], stack: ExitStack) -> FileRows:
    """Rows (H, W, S) in a temporary file that ``stack`` removes; raises MemoryError if the disk has no room for it."""
    needed, folder = math.prod(shape) * dtype.itemsize, tempfile.gettempdir()
    free = shutil.disk_usage(folder).free
    if needed > free:  # writing to mapped memory would end the process
        raise MemoryError(
            f"a temporary file of {needed / 1e6:.0f} MB is needed for the pixels, but only {free / 1e6:.0f} MB are "
            f"free in {folder}; free some, or set TMPDIR to a folder with more"
        )
    stream = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115 - the stack closes it
    stream.truncate(needed)
    return FileRows(stream, shape, dtype)
