"""Colour tables of other programs, as lattices of a look: ``.cube`` files, and pictures of all colours (Hald).

A ``.cube`` file, as Adobe defined it, lists colours in lines, a Hald in rows of pixels; of both, red changes from one
colour to the next. Imports neither torch nor, before it is needed, NumPy.
"""

import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from nlfilter_torch.photo.declared.declaration import MAX_NODES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Values = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.floating]

Lattice = tuple[float, ...]  # changes of colours, as the parameter of ``look`` has them
EXPORT = "export a 3-D table of colours from 0 to 1"
MOST_HALD_LEVEL = math.isqrt(MAX_NODES)
CURVES, COLOURS = "LUT_1D", "LUT_3D"  # the tables of a .cube file
MOST_CURVE_NODES = 65536
NODE_COUNT = re.compile(r"\d{1,9}(?:\.\d*)?")  # of nodes; some programs write 33.0
CUBE_NODES, HALD_LEVEL = 33, 8  # of the tables that are written
WHITE_16 = 65535


@dataclass
class Cube:
    """What a ``.cube`` file holds.

    Attributes:
        sizes: of the table of curves, which comes first and may be missing, and of the table of colours.
        ranges: colours, (3,) each, from which and to which the tables reach.
        rows: of all tables.
    """

    sizes: dict[str, int] = field(default_factory=lambda: {CURVES: 0, COLOURS: 0})
    ranges: dict[str, tuple[list[float], list[float]]] = field(
        default_factory=lambda: {table: ([0.0] * 3, [1.0] * 3) for table in (CURVES, COLOURS)}
    )
    rows: list[list[float]] = field(default_factory=list)

    def accept(self, words: list[str], name: str) -> None:
        """Accept a line of keywords; those of other programs are ignored.

        Raises:
            ValueError: if the line says that the table is of another kind.
        """
        keyword, values, place = words[0].upper(), words[1:], f"{words[0]} of {name}"
        table = keyword[:6]
        if keyword in ("DOMAIN_MIN", "DOMAIN_MAX"):
            for ends in self.ranges.values():
                ends[keyword == "DOMAIN_MAX"][:] = _numbers(values, 3, place)
        elif keyword == f"{table}_INPUT_RANGE" and table in self.ranges:
            least, most = _numbers(values, 2, place)
            self.ranges[table] = ([least] * 3, [most] * 3)
        elif keyword == f"{table}_SIZE" and table in self.sizes:
            most_nodes = MAX_NODES if table == COLOURS else MOST_CURVE_NODES
            size = float(values[0]) if len(values) == 1 and NODE_COUNT.fullmatch(values[0]) else 0.0
            if size != int(size) or not 2 <= size <= most_nodes:
                raise ValueError(
                    f"{place} must be a whole number from 2 to {most_nodes}, got {' '.join(values)}; "
                    "export a table of such a size"
                )
            self.sizes[table] = int(size)
        elif "VIDEO_RANGE" in keyword:
            raise ValueError(f"{name} must be a table for colours of full range, got a line {keyword[:40]}; {EXPORT}")

    def table(self) -> "NDArray[np.floating]":
        """The colours (n^3, 3) for colours from 0 to 1, in the order of files.

        The table itself if it has that range and no curves, else what curves and table give at the nodes of the largest
        table that a look can have.
        """
        import numpy as np

        curves, size = self.sizes[CURVES], self.sizes[COLOURS]
        rows = np.array(self.rows)
        colours = rows[curves:]
        if not curves and self.ranges[COLOURS] == ([0.0] * 3, [1.0] * 3):
            return colours
        nodes = np.linspace(0, 1, MAX_NODES)[:, None].repeat(3, 1)
        if curves:
            places = _places(nodes, self.ranges[CURVES], curves)
            nodes = np.stack([np.interp(places[:, c], np.arange(curves), rows[:curves, c]) for c in range(3)], axis=1)
        if not size:
            red, green, blue = nodes.T
            mixed = np.meshgrid(blue, green, red, indexing="ij")
            return np.stack(mixed[::-1], axis=-1).reshape(-1, 3)
        places = _places(nodes, self.ranges[COLOURS], size)
        red, green, blue = np.maximum(0, 1 - np.abs(places.T[..., None] - np.arange(size)))  # weights, (n, size) each
        table = colours.reshape(size, size, size, 3)
        return np.einsum("kc,jb,ia,cbad->kjid", blue, green, red, table, optimize=True).reshape(-1, 3)


def _places(
    colours: "NDArray[np.floating]", ends: tuple[list[float], list[float]], size: int
) -> "NDArray[np.floating]":
    """Where colours (n, 3) lie among the nodes of a table, from 0 to its size less 1; those outside at its ends."""
    import numpy as np

    least, most = np.array(ends)
    return np.clip((colours - least) / (most - least), 0, 1) * (size - 1)


def lattice_of_cube(text: str, name: str) -> Lattice:
    """The lattice of a table in a ``.cube`` file: of colours, of a curve for each channel, or of colours after curves.

    Raises:
        ValueError: if it holds no table. ``name`` is the file's name in the message.
    """
    cube = Cube()
    # Some programs end texts as CP/M did. Unicode has more ends of lines, which may be in a title.
    for number, line in enumerate(re.split(r"\r\n|\r|\n", text.rstrip("\0\x1a \t\r\n")), 1):
        words = re.split("#|//", line)[0].split()
        if not words:
            continue
        if words[0][0].isalpha() and words[0].lower() not in ("nan", "inf", "infinity"):
            cube.accept(words, name)
        else:
            cube.rows.append(_numbers(words, 3, f"line {number} of {name}"))
    curves, size = cube.sizes[CURVES], cube.sizes[COLOURS]
    if not curves and not size:
        raise ValueError(f"{name} must have a line LUT_3D_SIZE, got none; {EXPORT}")
    if len(cube.rows) != curves + size**3:
        wanted = f"{size}^3 = {size**3} colours" if not curves else f"{curves} + {size}^3 colours"
        raise ValueError(f"{name} must hold {wanted}, got {len(cube.rows)}; export it again")
    for least, most in cube.ranges.values():
        if not all(start < end for start, end in zip(least, most, strict=True)):
            raise ValueError(
                f"{name} must be for colours from a least to a greater one, got {least} to {most}; {EXPORT}"
            )
    return lattice_of_table(cube.table())


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
