"""``nlfilter-torch presets``: list the named presets and looks."""

from typing import Annotated

import typer

from nlfilter_torch.photo.declared.looks import CHARACTERS
from nlfilter_torch.photo.declared.presets import PRESETS, PURPOSES, find_recipe

Name = Annotated[
    str | None,
    typer.Argument(
        metavar="NAME", help="Print this preset or look as JSON, to be edited and passed to `apply --preset`."
    ),
]


def presets(name: Name = None) -> None:
    """List the presets and looks for `nlfilter-torch detail --preset NAME`, or print one of them as a file.

    To start one of your own: `nlfilter-torch presets crisp > mine.json`
    """
    if name is not None:
        typer.echo(find_recipe(name).to_json(complete=True), nl=False)
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("preset", "alpha", "bandwidth", "what it does")
    for title, preset in PRESETS.items():
        step = preset.steps[0]
        sliders = ", ".join(f"{value:g}" for value in step["alpha"])
        bandwidth = step["bandwidth"] if isinstance(step["bandwidth"], str) else f"{step['bandwidth']:g}"
        table.add_row(title, sliders, bandwidth, PURPOSES[title])
    console = Console()
    console.print(table)
    looks = Table("look", "what it does")
    for title, character in CHARACTERS.items():
        looks.add_row(title, character)
    console.print(looks)
