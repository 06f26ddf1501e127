"""How far what the editor shows is from what it saves: ``python -m benchmarks.preview [--pictures FOLDER]``.

Each photograph is opened in a session of the editor, edited, and saved. Printed is the root mean square difference in
grey levels between the picture on the screen, before it becomes a JPEG, and the saved file resized to its size: for
each edit the mean over all photographs and strides and the largest, the mean of each stride, and by how much the edit
changes the picture. The editor first shows a fast preview, and once nothing has changed for a second the edit of the
whole photograph; the figures are those of the latter and, below "fast", of the former.

G'MIC and darktable do the same if they are installed (``--peers``): G'MIC edits the photograph and its reduction, and
darktable exports it in a smaller size from its fast pipeline, which its own preview uses, and from its full one.

A photograph is resized to ``stride`` times the side of the preview, and the viewing size has the proportion to the
preview that it has in the editor, 1, so that small previews show what large ones would; ``--pixels 1500000`` measures
these.
"""

import math
import statistics
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import tifffile
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import editors
from benchmarks.harness import options
from benchmarks.photographs import pictures
from nlfilter_torch.photo.app.preview import PIXELS
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.parameters import VIEWING_SIZE
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.selections import mask

NAMES = ("chelsea", "coffee", "rocket", "motorcycle", "astronaut", "retina")
HERE, THERE = ((0.45, 0.5), (0.52, 0.5)), ((0.1, 0.1), (0.16, 0.1))
FILES = ("small.tif", "whole.tif")
SOFTER = tuple((i / 16) ** 0.9 for i in range(17))
EDITS = {
    "detail": Step("detail", alpha=(2.0, 2.0, 2.0, 1.0)),
    "detail of a region": Step("detail", (Stroke(HERE, 0.03, "in"),), alpha=(1.0,) * 4, inside=(3.0, 3.0, 2.0, 1.0)),
    "tone": Step("tone", contrast=1.2, clarity=2.0),
    "sharpen": Step("sharpen"),
    "denoise": Step("denoise"),
    "recolor": Step("recolor", (Stroke(HERE, 0.03, "#2040e0"),)),
    "colorize": Step("colorize", (Stroke(HERE, 0.03, "#b03020"), Stroke(THERE, 0.03, "#20b0e0"))),
    "defocus": Step("defocus", (Stroke(HERE, 0.03, "in"),)),
    "abstract": Step("abstract"),
    "abstract, lines and tones": Step("abstract", edges=0.8, tones=8),
    "look": Step("look", alpha=(2.0, 1.5, 1.0, 1.0), red=SOFTER, saturation=(1.2,) * 5),
}
RECIPES = {name: Recipe((step,)) for name, step in EDITS.items()}
RECIPES["detail, recolor and defocus"] = Recipe((EDITS["detail"], EDITS["recolor"], EDITS["defocus"]))


def scaled(recipe: Recipe, pixels: int) -> Recipe:
    """A recipe whose viewing sizes have the same proportion to a preview of so many pixels as in the editor."""
    size = VIEWING_SIZE.default * pixels / PIXELS
    changed = [step.changed(viewing_size=size) if "viewing_size" in names(step) else step for step in recipe.steps]
    return Recipe(tuple(changed))


def names(step: Step) -> set[str]:
    """Of the parameters of a step."""
    return {parameter.name for parameter in step.declared}


def sized(picture: Tensor, pixels: int, stride: int) -> Tensor:
    """A photograph (1, 3, H, W) of which a preview of at most so many pixels has one in ``stride`` each way."""
    scale = math.sqrt(pixels / (picture.shape[-2] * picture.shape[-1]))
    size = [int(length * scale) * stride for length in picture.shape[-2:]]
    return F.interpolate(picture.float(), size, mode="bicubic", antialias=True).clamp(0, 1)


def errors(picture: Tensor, pixels: int, stride: int, recipes: dict[str, Recipe]) -> Iterator[tuple[str, float, float]]:
    """For each recipe its name, the difference between preview and saved file, and how much the edit changes.

    Then the same for the fast preview.
    """
    mask.VIEWED = VIEWING_SIZE.default * pixels / PIXELS  # in proportion, as in the editor
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photograph.tif"
        photograph = Photograph(sized(picture, pixels, stride))
        write_photograph(replace(photograph, depth="uint16"), path)
        session = Session(Path(folder), path, pixels=pixels)
        assert round(session.preview.stride) == stride
        for name, recipe in recipes.items():
            session.load(scaled(recipe, pixels))
            saved = resize(read_photograph(session.save("saved.tif")).pixels, session.preview.size).clamp(0, 1)
            change = levels(saved - session.preview.pixels.clamp(0, 1))
            yield name, levels(session.at_rest(session.recipe) - saved), change
            yield f"{name} (fast)", levels(session.render() - saved), change


def errors_of_peers(picture: Tensor, pixels: int, stride: int) -> Iterator[tuple[str, float, float]]:
    """:func:`errors` of the other editors that are installed."""
    photograph = sized(picture, pixels, stride)
    height, width = (length // stride for length in photograph.shape[-2:])
    small = resize(photograph, (height, width)).clamp(0, 1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, image in (("whole.tif", photograph), ("small.tif", small)):
            write_photograph(Photograph(image, "uint16"), folder / file)
        reduced = ("--width", str(width), "--height", str(height), "--hq")
        for peer, command in editors.installed().items():
            if peer == "gmic":
                shown, saved = (edited(command(folder / file, folder / "out.tif", folder)) for file in FILES)
                saved = resize(saved, (height, width)).clamp(0, 1)
            else:
                shown, saved = (
                    edited(command(folder / "whole.tif", folder / "out.tif", folder, *reduced, quality)).clamp(0, 1)
                    for quality in ("false", "true")
                )
            yield f"{peer}, nearest to detail", levels(shown - saved), levels(saved - small)


def edited(command: list[str]) -> Tensor:
    """The picture (1, 3, H, W) that a command writes to ``out.tif`` in the folder of its input."""
    target = Path(command[1]).with_name("out.tif")
    target.unlink(missing_ok=True)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not target.exists():
        raise SystemExit(f"{command[0]} wrote no file: {done.stdout}{done.stderr}")
    return torch.from_numpy(tifffile.imread(target)).permute(2, 0, 1)[None]


def levels(difference: Tensor) -> float:
    """Root mean square in grey levels of 255."""
    return float(255 * difference.square().mean().sqrt())


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = options("preview", __doc__, "one photograph, a small preview of stride 2")
    add = parser.add_argument
    add("--pictures", type=Path, help="a folder of photographs in place of scikit-image's")
    add("--pixels", type=int, default=150_000, help="of the preview, at most")
    add("--strides", type=int, nargs="+", default=[2, 3, 5, 8])
    add("--edits", nargs="+", choices=RECIPES, default=list(RECIPES), metavar="EDIT")
    add("--peers", action="store_true", help="G'MIC and darktable, too")
    add("--most", type=int, default=6, help="photographs")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.pixels, chosen.strides, chosen.most = 6_000, [2], 1
    recipes = {name: RECIPES[name] for name in chosen.edits}
    photographs = list(pictures(chosen.pictures, 1 << 20, NAMES).items())[: chosen.most]
    results: dict[str, dict[int, list[tuple[float, float]]]] = {}
    for stride in chosen.strides:
        for title, picture in photographs:
            peers = errors_of_peers(picture, chosen.pixels, stride) if chosen.peers else ()
            for name, error, change in chain(errors(picture, chosen.pixels, stride, recipes), peers):
                results.setdefault(name, {}).setdefault(stride, []).append((error, change))
                print(f"{title}, stride {stride}, {name}: {error:.2f} of {change:.1f}", flush=True)
    print(f"\n{len(photographs)} photographs, previews of {chosen.pixels} pixels, {torch.get_num_threads()} threads")
    strides = "".join(f"{f'stride {stride}':>10}" for stride in chosen.strides)
    print(f"{'RMS difference in grey levels':<32}{'mean':>8}{'largest':>9}{strides}{'change':>9}")
    for name, by_stride in results.items():
        pairs = [pair for rows in by_stride.values() for pair in rows]
        mean, change = (statistics.mean(column) for column in zip(*pairs, strict=True))
        cells = "".join(f"{statistics.mean(error for error, _ in by_stride[s]):>10.2f}" for s in chosen.strides)
        print(f"{name:<32}{mean:>8.2f}{max(error for error, _ in pairs):>9.2f}{cells}{change:>9.1f}")


if __name__ == "__main__":
    main()
