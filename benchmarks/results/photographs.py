"""Calls of what reads, edits, draws and writes photographs."""

from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

import nlfilter_torch as nf
from benchmarks.results import inputs
from benchmarks.results.digests import of_file
from benchmarks.results.functions import Calls

# The first module that has a name is asked for it: names moved from the others to nlfilter_torch.photo.
MODULES = ("photo", "io", "plotting", "edits.presets", "edits.steps", "edits.scribbles")
FILES = (
    "photo.png",
    "grey.png",
    "clear.png",
    "photo.jpg",
    "photo.webp",
    "deep.png",
    "photo.tif",
    "deep.tif",
    "float.tif",
)
DRAWN = ("show_images", "show_layers", "show_eigenvectors", "show_mask", "plot_eigenvalues", "plot_response")


def public(name: str) -> Any:
    """A public name of the application."""
    for module in MODULES:
        try:
            return getattr(import_module(f"nlfilter_torch.{module}"), name)
        except (ModuleNotFoundError, AttributeError):
            continue
    raise AttributeError(f"none of the modules {', '.join(MODULES)} has {name}")


def calls() -> Calls:
    """Calls of functions for files, presets and drawings."""
    recipes: Calls = {f"recipe {name}": partial(of_recipe, recipe) for name, recipe in public("PRESETS").items()}
    return {
        **{f"read and write {name}": partial(of_photograph, name) for name in FILES},
        **{f"draw {name}": partial(of_drawing, name) for name in DRAWN},
        **recipes,
        "recipe of steps": lambda: of_recipe(strokes_and_steps()),
        "recipe of a file": lambda: of_recipe(from_file("every.json")),
    }


def of_photograph(name: str) -> list[Any]:
    """A photograph that is read, and the files of it."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        inputs.write_files(folder)
        photograph = public("read_photograph")(folder / name)
        kinds = {"uint8": ("png", "tif", "webp"), "uint16": ("png", "tif"), "float32": ("tif",)}
        targets = [folder / f"again.{kind}" for kind in kinds[photograph.depth]]
        for target in targets:
            public("write_photograph")(photograph.with_pixels(photograph.pixels * 0.9), target)
        return [photograph, [of_file(target, folder) for target in targets]]


def of_drawing(name: str) -> object:
    """A drawing, as a file."""
    guide = inputs.image("camera", torch.float32)
    built = nf.nonlocal_operator(guide, num_landmarks=40, photometric_bandwidth=0.2)
    spectrum, region = built.spectrum(), inputs.box(3, 4, torch.float32)
    arguments: dict[str, tuple[Any, ...]] = {
        "show_images": ({"A guide": guide, "A photograph": inputs.image("coffee", torch.float32)},),
        "show_layers": (nf.detail_layers(built, guide),),
        "show_eigenvectors": (spectrum,),
        "show_mask": (guide, region, nf.diffusion_mask(spectrum, region)),
        "plot_eigenvalues": (spectrum,),
        "plot_response": (torch.tensor([2.0, 1.0, 0.5]), spectrum),
    }
    with TemporaryDirectory() as folder:
        path = Path(folder) / "drawing.png"
        public("save_figure")(public(name)(*arguments[name]), path)
        return of_file(path, path.parent)


def strokes_and_steps() -> Any:
    """A recipe made from steps and strokes."""
    step, stroke = public("Step"), public("Stroke")
    lines = (stroke(((0.2, 0.3), (0.4, 0.4)), 0.06, "in"), stroke(((0.8, 0.7),), 0.1, "out"))
    return public("Recipe")((step("detail", lines, inside=(3.0, 1.0, 1.0, 1.0)), step("tone", contrast=1.3)))


def from_file(name: str) -> Any:
    """A recipe of the inputs."""
    with TemporaryDirectory() as folder:
        inputs.write_files(Path(folder))
        return public("find_recipe")(str(Path(folder) / name))


def of_recipe(recipe: Any) -> list[Any]:
    """A recipe as text, and a photograph under it."""
    image = inputs.image("coffee", torch.float32)
    edited = recipe.apply(image) if hasattr(recipe, "apply") else public("apply_recipe")(recipe, image)
    return [recipe.to_json(), recipe.to_json(complete=True), edited]
