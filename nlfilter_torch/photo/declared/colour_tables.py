"""Colour tables of other programs, as lattices of a look: ``.cube`` files, and pictures of all colours (Hald).

A ``.cube`` file, as Adobe defined it, lists colours in lines, a Hald in rows of pixels; of both, red changes from one
colour to the next. Imports neither torch nor, before it is needed, NumPy.
"""

import math
from typing import TYPE_CHECKING

from nlfilter_torch.photo.declared.declaration import MAX_NODES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Values = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.floating]

Lattice = tuple[float, ...]  # changes of colours, as the parameter of ``look`` has them
EXPORT = "export a 3-D table of colours from 0 to 1"
MOST_HALD_LEVEL = math.isqrt(MAX_NODES)
CUBE_NODES, HALD_LEVEL = 33, 8  # of the tables that are written
WHITE_16 = 65535


def lattice_of_cube(text: str, name: str) -> Lattice:
    """The lattice of a table in a ``.cube`` file.

    Raises:
        ValueError: if it is not a 3-D table of colours from 0 to 1. ``name`` is the file's name in the message.
    """
    size, rows = 0, list[list[float]]()
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0][0].isalpha() and words[0].lower() not in ("nan", "inf", "infinity"):
            size = _size(words, size, name)
        else:
            rows.append(_numbers(words, 3, f"line {number} of {name}"))
    if not size:
        raise ValueError(f"{name} must have a line LUT_3D_SIZE, got none; {EXPORT}")
    if len(rows) != size**3:
        raise ValueError(f"{name} must hold {size}^3 = {size**3} colours, got {len(rows)}; export it again")
    import numpy as np

    return lattice_of_table(np.array(rows))


def lattice_of_hald(picture: "Values", name: str) -> Lattice:
    """The lattice of a picture (H, W, C) of all colours, in 8 or 16 bits or in floats.

    Raises:
        ValueError: if it is none: its sides are the cube of a whole number.
    """
    import numpy as np

    height, width = picture.shape[:2]
    level = round(height ** (1 / 3))
    if height != width or level**3 != height or level < 2 or picture.ndim != 3 or picture.shape[2] < 3:
        raise ValueError(
            f"{name} must be a Hald, a square picture in colour of 8, 27, 64, ... 512 pixels, got {width}x{height}; "
            "edit one that ImageMagick makes: convert hald:8 hald.png"
        )
    if level > MOST_HALD_LEVEL:
        raise ValueError(f"{name} must be a Hald of level {MOST_HALD_LEVEL} at most, got {level}; make a smaller one")
    white = {"uint8": 255, "uint16": WHITE_16}.get(picture.dtype.name, 1)
    return lattice_of_table(np.asarray(picture[..., :3], dtype=np.float64).reshape(-1, 3) / white)


def lattice_of_table(colours: "NDArray[np.floating]") -> Lattice:
    """The lattice of a table (n^3, 3) of colours, in the order of files."""
    import numpy as np

    size = round(len(colours) ** (1 / 3))
    table = colours.reshape(size, size, size, 3).transpose(3, 2, 1, 0)
    changes = table - np.stack(np.meshgrid(*[np.arange(size) / (size - 1)] * 3, indexing="ij"))
    return tuple(np.round(changes, 6).ravel().tolist())


def table_rows(table: "NDArray[np.floating]") -> "NDArray[np.floating]":
    """Colours (n^3, 3) in the order of files, of a table (3, n, n, n) by red, green and blue."""
    return table.transpose(3, 2, 1, 0).reshape(-1, 3)


def cube_of(table: "NDArray[np.floating]", title: str) -> str:
    """A ``.cube`` file of a table (3, n, n, n) by red, green and blue."""
    head = f'TITLE "{title}"\nLUT_3D_SIZE {len(table[0])}\nDOMAIN_MIN 0 0 0\nDOMAIN_MAX 1 1 1\n'
    return head + "".join(f"{red:.6f} {green:.6f} {blue:.6f}\n" for red, green, blue in table_rows(table).tolist())


def hald_of(table: "NDArray[np.floating]") -> "NDArray[np.uint16]":
    """A Hald (side, side, 3), in 16 bits, of a table (3, n, n, n); n is the square of its level."""
    import numpy as np

    side = math.isqrt(len(table[0])) ** 3
    levels = np.clip(np.rint(table_rows(table) * WHITE_16), 0, WHITE_16)
    return levels.reshape(side, side, 3).astype(np.uint16)


def _size(words: list[str], size: int, name: str) -> int:
    """The size of the table after a line of keywords.

    Raises:
        ValueError: if the line says that the table is of another kind.
    """
    keyword, place, rest = words[0].upper(), f"{words[0]} of {name}", " ".join(words[1:])
    if keyword in ("DOMAIN_MIN", "DOMAIN_MAX"):
        wanted = "1 1 1" if keyword == "DOMAIN_MAX" else "0 0 0"
        _check_ends(words[1:], wanted, place)
    elif keyword == "LUT_3D_INPUT_RANGE":
        _check_ends(words[1:], "0 1", place)
    elif keyword.startswith("LUT_1D"):
        raise ValueError(f"{name} must be a 3-D table, got a 1-D table; {EXPORT}")
    elif keyword == "LUT_3D_SIZE":
        if len(words) != 2 or not words[1].isdecimal() or not 2 <= int(words[1]) <= MAX_NODES:
            raise ValueError(
                f"{place} must be a whole number from 2 to {MAX_NODES}, got {rest}; export a table of such a size"
            )
        return int(words[1])
    elif keyword != "TITLE":
        raise ValueError(f"{name} must be a table of colours, got a line {words[0][:40]}; {EXPORT}")
    return size


def _check_ends(words: list[str], wanted: str, place: str) -> None:
    """Raise unless a table is for colours from 0 to 1."""
    ends = [float(end) for end in wanted.split()]
    if any(abs(value - end) > 1e-6 for value, end in zip(_numbers(words, len(ends), place), ends, strict=True)):
        raise ValueError(f"{place} must be {wanted}, got {' '.join(words)}; {EXPORT}")


def _numbers(words: list[str], count: int, place: str) -> list[float]:
    """That many finite numbers."""
    try:
        values = [float(word) for word in words if "_" not in word]  # Python takes 1_0 for 10
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        shown = "".join(letter if letter.isprintable() else "?" for letter in " ".join(words)[:60])
        raise ValueError(f"{place} must hold {count} numbers, got {shown}; export it again")
    return values
