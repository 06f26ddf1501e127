"""Drawn repeated patterns: facades, bricks, tiles, gratings, fabrics and text, seen at an angle, no two cells alike.

Patterns of training and patterns held out for reporting (herringbone, scales, hexagons, meshes, plaids, digits) are two
families without a common kind.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

FINER = 3  # pixels drawn for a pixel, in both directions
PERIODS = 5.0, 40.0  # pixels of a cell
CELLS = 64  # per side, of the table of what differs between cells


@dataclass(frozen=True)
class Lattice:
    """Where each drawn pixel is in a lattice of cells.

    Attributes:
        across, along: coordinates (N, N) in cells.
        generator: of all random numbers.
    """

    across: Tensor
    along: Tensor
    generator: torch.Generator

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        """A random number."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def colour(self) -> Tensor:
        """A random colour (3, 1, 1), grey to saturated."""
        colour = torch.rand(3, 1, 1, generator=self.generator)
        return torch.lerp(colour.mean().expand_as(colour), colour, self.number())

    def shifted(self, across: Tensor | float, along: Tensor | float) -> "Lattice":
        """The lattice moved by a number of cells."""
        return Lattice(self.across + across, self.along + along, self.generator)

    @property
    def within(self) -> tuple[Tensor, Tensor]:
        """Coordinates within a cell, from 0 to 1."""
        return self.across - self.across.floor(), self.along - self.along.floor()

    def varied(self, spread: float) -> Tensor:
        """A factor (N, N) near 1 that differs between cells."""
        return 1 + spread * (self.chosen() - 0.5)

    def chosen(self) -> Tensor:
        """A random number (N, N) from 0 to 1 for each cell."""
        numbers = torch.rand(CELLS, CELLS, generator=self.generator)
        return numbers[self.along.floor().long() % CELLS, self.across.floor().long() % CELLS]


def paint(picture: Tensor, mask: Tensor, colour: Tensor) -> Tensor:
    """Replace a picture (3, N, N) by a colour where a mask (N, N) is true."""
    return torch.where(mask, colour, picture)


def facade(lattice: Lattice) -> Tensor:
    """Windows with frames and sills in a wall; some are lit, some have a blind."""
    across, along = lattice.within
    left, top = lattice.number(0.1, 0.3), lattice.number(0.1, 0.3)
    inside = ((across - 0.5).abs() < 0.5 - left) & ((along - 0.5).abs() < 0.5 - top)
    frame = ((across - 0.5).abs() < 0.46 - left) & ((along - 0.5).abs() < 0.46 - top)
    picture = paint((lattice.colour() * torch.ones_like(across)), inside, lattice.colour())
    blinds = along < lattice.chosen() * lattice.number(0, 1)
    glass = torch.where(blinds, lattice.colour(), lattice.colour() * lattice.varied(0.8))
    picture = paint(picture, frame, glass)
    bars = (across - 0.5).abs() < lattice.number(0.0, 0.05)
    picture = paint(picture, frame & bars, lattice.colour())
    return paint(picture, along > 1 - lattice.number(0, 0.12), lattice.colour())


def bricks(lattice: Lattice) -> Tensor:
    """Bricks in mortar, every second row moved by half of a brick."""
    flat = Lattice(lattice.across * lattice.number(0.4, 0.8), lattice.along, lattice.generator)
    rows = flat.shifted(0.5 * (flat.along.floor() % 2), 0)
    across, along = rows.within
    gap = lattice.number(0.03, 0.12)
    mortar = (across < gap / 2) | (along < gap)
    shade = 1 - lattice.number(0, 0.3) * along
    return paint(lattice.colour() * rows.varied(lattice.number(0.1, 0.6)) * shade, mortar, lattice.colour())


def tiles(lattice: Lattice) -> Tensor:
    """Tiles with the same few random shapes in each; every second one may be mirrored."""
    across, along = lattice.within
    if lattice.number() < 0.5:
        odd = ((lattice.across.floor() + lattice.along.floor()) % 2).bool()
        across = torch.where(odd, 1 - across, across)
    picture = lattice.colour() * lattice.varied(lattice.number(0, 0.3))
    for _ in range(4):
        middle, size = torch.rand(2, 2, generator=lattice.generator).tolist()
        square = ((across - middle[0]).abs(), (along - middle[1]).abs())
        width, height = (0.08 + 0.3 * length for length in size)
        ellipse = (square[0] / width).square() + (square[1] / height).square() < 1
        shape = ellipse if lattice.number() < 0.5 else (square[0] < width) & (square[1] < height)
        picture = paint(picture, shape, lattice.colour())
    return paint(picture, (across < 0.05) | (along < 0.05), lattice.colour())


def grating(lattice: Lattice) -> Tensor:
    """Bars, soft or sharp, now and then with crossbars."""
    across = lattice.within[0]
    width = lattice.number(0.2, 0.8)
    soft = 0.5 + 0.5 * torch.sin(2 * math.pi * across)
    share = soft if lattice.number() < 0.3 else (across < width).float()
    picture = torch.lerp(lattice.colour(), lattice.colour(), share)
    crossbar = Lattice(lattice.across, lattice.along / 4, lattice.generator).within[1] < 0.05
    return paint(picture, crossbar, lattice.colour()) if lattice.number() < 0.4 else picture


def fabric(lattice: Lattice) -> Tensor:
    """Two sets of threads that go over and under each other."""
    across, along = lattice.within
    twill = 2 if lattice.number() < 0.5 else 3
    over = (lattice.across.floor() + lattice.along.floor()) % twill < 1
    first, second = (torch.sin(math.pi * place) ** 0.5 for place in (across, along))
    spread = lattice.number(0, 0.3)
    upper = lattice.colour() * first * lattice.varied(spread)
    return torch.where(over, upper, lattice.colour() * second * lattice.varied(spread))


def text(lattice: Lattice) -> Tensor:
    """Lines of letters, each a random sign of 5 x 7 squares from a small alphabet, with spaces."""
    return _written(lattice, torch.rand(8, 7, 5, generator=lattice.generator) < 0.5)


def digits(lattice: Lattice) -> Tensor:
    """Lines of digits of seven segments."""
    segments = [0b1110111, 0b0010010, 0b1011101, 0b1011011, 0b0111010, 0b1101011, 0b1101111, 0b1010010]
    signs = torch.zeros(8, 7, 5, dtype=torch.bool)
    parts = [(0, slice(1, 4)), (slice(1, 3), 0), (slice(1, 3), 4), (3, slice(1, 4)), (slice(4, 6), 0), (slice(4, 6), 4)]
    parts.append((6, slice(1, 4)))
    for number, segment in enumerate(segments):
        for part, place in enumerate(parts):
            signs[number][place] = bool(segment >> (6 - part) & 1)
    return _written(lattice, signs)


def _written(lattice: Lattice, signs: Tensor) -> Tensor:
    across, along = lattice.within
    choice = (lattice.chosen() * len(signs) * 1.2).long()  # the last sixth are spaces
    row, column = ((along * 9 - 1).floor().long(), (across * 6).floor().long())
    inside = (row >= 0) & (row < 7) & (column < 5) & (choice < len(signs))
    ink = signs[choice.clamp(max=len(signs) - 1), row.clamp(0, 6), column.clamp(max=4)] & inside
    return paint(lattice.colour() * torch.ones_like(across), ink, lattice.colour())


def herringbone(lattice: Lattice) -> Tensor:
    """Planks in V-shaped rows."""
    slant = (lattice.across % 2 - 1).abs()
    planks = Lattice(lattice.across, lattice.along + slant, lattice.generator)
    across, along = planks.within
    seam = (along < 0.08) | (across < 0.04)
    return paint(lattice.colour() * planks.varied(0.5), seam, lattice.colour())


def scales(lattice: Lattice) -> Tensor:
    """Round scales or roof tiles that overlap."""
    picture = lattice.colour() * torch.ones_like(lattice.across)
    light, dark = lattice.colour(), lattice.colour()
    for row in range(3):
        moved = lattice.shifted(0.5 * ((lattice.along.floor() + row) % 2), 0)
        across, along = moved.within
        distance = ((across - 0.5).square() + ((along + row - 1) * 0.6).square()).sqrt()
        scale = torch.lerp(light, dark, (2 * distance).clamp(0, 1)) * moved.varied(0.3)
        picture = paint(picture, distance < 0.5, paint(scale, distance > 0.44, dark * 0.5))
    return picture


def hexagons(lattice: Lattice) -> Tensor:
    """Hexagonal tiles: each pixel belongs to the nearer of two shifted rectangular lattices."""
    wide = Lattice(lattice.across, lattice.along / 3**0.5, lattice.generator)
    both = [wide, wide.shifted(0.5, 0.5)]
    distances = []
    for grid in both:
        across, along = grid.within
        distances.append(((across - 0.5).square() + 3 * (along - 0.5).square()).sqrt())
    first = distances[0] < distances[1]
    picture = torch.where(first, both[0].varied(0.5), both[1].varied(0.5)) * lattice.colour()
    seam = (distances[0] - distances[1]).abs() < lattice.number(0.04, 0.12)
    return paint(picture, seam, lattice.colour())


def mesh(lattice: Lattice) -> Tensor:
    """A fence of diagonal wires before two colours."""
    first, second = ((lattice.across + sign * lattice.along) % 1 - 0.5 for sign in (1, -1))
    width = lattice.number(0.05, 0.15)
    picture = torch.lerp(lattice.colour(), lattice.colour(), (lattice.along / 9 % 1))
    wire = (1 - (first / width).square()).clamp(min=0).sqrt() * lattice.colour()
    picture = paint(picture, first.abs() < width, wire)
    return paint(picture, second.abs() < width, (1 - (second / width).square()).clamp(min=0).sqrt() * lattice.colour())


def plaid(lattice: Lattice) -> Tensor:
    """Crossed stripes of several widths, with a fine twill."""
    stripes = torch.rand(2, 8, 3, generator=lattice.generator)
    across, along = (
        stripes[axis][(8 * place).floor().long() % 8].movedim(-1, 0)
        for axis, place in enumerate((lattice.across, lattice.along))
    )
    fine = (12 * (lattice.across + lattice.along)) % 1 < 0.5
    return torch.where(fine, across, along)


#: Kinds of training, and kinds held out for reporting.
TRAINED: dict[str, Callable[[Lattice], Tensor]] = {
    kind.__name__: kind for kind in (facade, bricks, tiles, grating, fabric, text)
}
APART: dict[str, Callable[[Lattice], Tensor]] = {
    kind.__name__: kind for kind in (herringbone, scales, hexagons, mesh, plaid, digits)
}


def pattern(side: int, generator: torch.Generator, *, kind: str | None = None, held_out: bool = False) -> Tensor:
    """Draw a repeated pattern (3, side, side) in [0, 1].

    Args:
        side: in pixels.
        generator: of all random numbers.
        kind: one of :data:`TRAINED` or :data:`APART`; by default a random one of the family.
        held_out: whether the family is the one kept aside.
    """
    family = APART if held_out else TRAINED
    draw = list(family.values())[int(torch.randint(len(family), (), generator=generator))]
    if kind is not None:
        draw = (TRAINED | APART)[kind]
    lattice = _lattice(side, generator)
    picture = draw(lattice).clamp(0, 1)
    shade = torch.rand(1, 1, 3, 3, generator=generator) * lattice.number(0, 0.5)
    light = 1 - F.interpolate(shade, picture.shape[-2:], mode="bilinear", align_corners=True)[0]
    return F.avg_pool2d(picture * light, FINER)


def _lattice(side: int, generator: torch.Generator) -> Lattice:
    """A lattice of a random size, turned, sheared and seen at an angle."""
    size, turn, stretch, shear, tilt, lean, row, column = torch.rand(8, generator=generator).tolist()
    period = PERIODS[0] * (PERIODS[1] / PERIODS[0]) ** size
    angle = 0.5 * math.pi * round(3 * turn) + 0.6 * (turn - 0.5) * (lean > 0.4)
    places = (torch.arange(FINER * side) + 0.5) / FINER - side / 2
    down, right = places[:, None], places[None]
    depth = 1 + (0.6 * (tilt - 0.5) * right + 0.6 * (lean - 0.5) * down) / side
    across = (right * math.cos(angle) + down * math.sin(angle)) / depth
    along = (down * math.cos(angle) - right * math.sin(angle)) / depth
    across = across + 0.3 * (shear - 0.5) * along
    return Lattice(across / period + 8 * row, along / (period * 1.6 ** (2 * stretch - 1)) + 8 * column, generator)
