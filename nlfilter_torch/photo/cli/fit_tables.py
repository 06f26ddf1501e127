"""Colour tables that ``nlfilter-torch fit`` writes beside a look."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlfilter_torch.photo.cli import options

if TYPE_CHECKING:
    from torch import Tensor

    from nlfilter_torch.photo.look_fitting.fit_look import FittedLook

CUBE_NODES = 33
ENOUGH = 0.8  # share that a table is to carry
Cube = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=f"A colour table of {CUBE_NODES}^3 for other programs, a .cube file: the part of the look that depends on "
        "the colour alone.",
    ),
]
Hald = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="The same as a picture, a Hald of level 8, in 16 bits: a PNG or TIFF file."),
]


@dataclass(frozen=True)
class Tables:
    """Files of colour tables, of the looks of one or several regions.

    Attributes:
        cube: a ``.cube`` file, or None.
        hald: a picture, or None.
    """

    cube: Path | None
    hald: Path | None

    def check(self, **inputs: list[Path]) -> None:
        """Raise ValueError or OSError unless the files can be written and differ from the inputs."""
        from nlfilter_torch.photo.cli.editing import check_apart
        from nlfilter_torch.photo.files.photographs import check_type
        from nlfilter_torch.photo.files.writing import check_file

        if self.cube is not None:
            check_file(self.cube)
            if self.cube.suffix.lower() != ".cube":
                raise ValueError(f"--cube must end in .cube, got {self.cube}; rename it")
            check_apart("--cube", self.cube, **inputs)
        if self.hald is not None:
            check_type(self.hald, "uint16", alpha=False)
            check_apart("--hald", self.hald, **inputs)

    def write(self, looks: "Sequence[FittedLook]") -> None:
        """Write the tables of looks; those of several get numbers."""
        for number, look in enumerate(looks, 1):
            ending = f"-{number}" if len(looks) > 1 else ""
            if self.cube is not None:
                _write_cube(look, self.cube.with_stem(self.cube.stem + ending))
            if self.hald is not None:
                _write_hald(look, self.hald.with_stem(self.hald.stem + ending))

    def report(self, look: "FittedLook", before: "Tensor", after: "Tensor") -> None:
        """Say what a table carries of the change between two pictures, and how exact it is, if there is one."""
        if self.cube is None and self.hald is None:
            return
        from nlfilter_torch.photo.edits.applying import apply_step
        from nlfilter_torch.photo.edits.colour_part import colour_part, table_error
        from nlfilter_torch.photo.look_fitting.alignment import explained

        share = explained(before, after, apply_step(colour_part(look.step), before).clamp(0, 1))
        error = table_error(look.step, CUBE_NODES, before)
        carried = f"{self.cube or self.hald} carries {100 * share:.1f} % of the change"
        typer.echo(f"table: {carried}; {CUBE_NODES}^3 colours are off by {error:.2f} levels of 255")
        if share < ENOUGH:
            options.note(
                f"a table carries less than {100 * ENOUGH:.0f} % of the edit, as the rest depends on the picture; "
                "use the preset with nlfilter-torch apply"
            )


def _write_cube(look: "FittedLook", path: Path) -> None:
    from nlfilter_torch.photo.declared.colour_tables import cube_of
    from nlfilter_torch.photo.edits.colour_part import colour_table
    from nlfilter_torch.photo.files.writing import open_beside

    with open_beside(path) as stream:
        stream.write(cube_of(colour_table(look.step, CUBE_NODES).numpy(), path.stem).encode())


def _write_hald(look: "FittedLook", path: Path) -> None:
    import torch

    from nlfilter_torch.photo.declared.colour_tables import HALD_LEVEL, hald_of
    from nlfilter_torch.photo.edits.colour_part import colour_table
    from nlfilter_torch.photo.files.photographs import Photograph, write_photograph

    levels = hald_of(colour_table(look.step, HALD_LEVEL**2).numpy())
    pixels = torch.from_numpy(levels.astype("float64") / 65535).permute(2, 0, 1)[None]
    write_photograph(Photograph(pixels, depth="uint16"), path)
