"""Debian packages as folders of files: downloading, unpacking, Qt's archives inside them, and licences."""

import fnmatch
import struct
import subprocess
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

RESOURCES = ".rcc"  # Qt's archives
FOLDER, COMPRESSED, OTHER = 2, 1, 4  # flags of their entries: zlib, and another compression that photographs never have


def unpacked(package: str, cache_folder: Path) -> Path:
    """The folder of a package's files; downloaded and unpacked if it is not there, never installed."""
    folder = cache_folder / package
    if not folder.exists():
        cache_folder.mkdir(parents=True, exist_ok=True)
        subprocess.run(["apt-get", "download", package], cwd=cache_folder, check=True, stdout=subprocess.DEVNULL)
        file = next(cache_folder.glob(f"{package}_*.deb"))
        partial = folder.with_suffix(".partial")
        subprocess.run(["dpkg-deb", "-x", file, partial], check=True)
        partial.rename(folder)
        file.unlink()
    return folder


def contents(folder: Path, path: str) -> bytes:
    """A file of an unpacked package; in Qt's archives if part of the path is the name of one."""
    before, archive, within = path.partition(RESOURCES + "/")
    if not archive:
        return (folder / path).read_bytes()
    return _resources(folder / (before + RESOURCES))[within]


@cache
def _resources(path: Path) -> dict[str, bytes]:
    return resources(path.read_bytes())


def resources(data: bytes) -> dict[str, bytes]:
    """The files of one of Qt's archives (of ``rcc --binary``), by their paths, without those compressed by zstd."""
    if data[:4] != b"qres":
        raise ValueError("data must be one of Qt's archives, which begin with 'qres'; see rcc --binary")
    version, tree, bodies, names = struct.unpack(">4I", data[4:20])
    size = 14 if version < 2 else 22  # of an entry of the tree, with or without times

    def walk(number: int, folder: str) -> Iterator[tuple[str, bytes]]:
        entry = tree + number * size
        name, flags, first, second = struct.unpack(">IHII", data[entry : entry + 14])
        (length,) = struct.unpack(">H", data[names + name : names + name + 2])
        text = data[names + name + 6 : names + name + 6 + 2 * length].decode("utf-16-be")
        path = f"{folder}{text}" if number else ""
        if flags & FOLDER:
            for child in range(second, second + first):
                yield from walk(child, f"{path}/" if path else "")
        elif not flags & OTHER:
            (length,) = struct.unpack(">I", data[bodies + second : bodies + second + 4])
            body = data[bodies + second + 4 : bodies + second + 4 + length]
            yield path, zlib.decompress(body[4:]) if flags & COMPRESSED else body

    return dict(walk(0, ""))


def licence(copyright_file: str, path: str) -> str:
    """Short name of the licence of a file, by a package's machine-readable copyright file: the last entry that fits."""
    name = "unknown"
    for paragraph in copyright_file.split("\n\n"):
        fields = _fields(paragraph)
        patterns = fields.get("files", "").split()
        if any(fnmatch.fnmatchcase(path, pattern) or Path(path).name == Path(pattern).name for pattern in patterns):
            name = fields.get("license", "unknown").splitlines()[0].strip()
    return name


def _fields(paragraph: str) -> dict[str, str]:
    fields: dict[str, str] = {}
    name = ""
    for line in paragraph.splitlines():
        if line[:1].isspace():
            fields[name] = f"{fields.get(name, '')}\n{line}"
        else:
            name, _, value = line.partition(":")
            name = name.lower()
            fields[name] = value.strip()
    return fields
