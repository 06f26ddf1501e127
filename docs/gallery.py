"""Pictures of edits for the documentation, before and after: ``python -m docs.gallery [FOLDER]``.

Each has three panels, such as the photograph with scribbles, what they select, and the result.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.photographs import luminance, scene, scribbled, spots, strokes
from docs.figures.colours import BLUE, TRUE, reached
from docs.figures.focus import WIDE, default_map
from docs.scenes import LETTERS, YELLOW, marked, painted_over
from nlfilter_torch.photo import abstract, colorize, defocus, enhance, recolor, region_mask
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.plotting import save_figure, show_images

SIDE = 270  # of a panel
FRONT = (432, 640)  # of a panel of the first picture
GAP = 5  # around it
SUBJECT = (  # a face, a collar and its ring, a suit
    *((205, 60, 30, 110), (215, 185, 30, 60), (200, 270, 40, 12), (126, 185, 10, 40)),
    *((90, 290, 60, 12), (300, 300, 40, 12)),
)
SIZE = 640  # of a photograph
ALPHA = (3.0, 3.0, 4.0, 1.0)


def detail() -> dict[str, Tensor]:
    """Detail enhancement of a suit."""
    image, scale = scene("astronaut", SIZE)
    spot = spots(image, scale, (60, 300, 20, 20), (300, 300, 20, 20))
    wide = (..., slice(130, 130 + round(512 / WIDE)), slice(None))
    panels = {
        "Spots (yellow)": marked(image, spot),
        "What is like them": region_mask(image, spot),
        "Detail where it is alike": enhance(image, torch.tensor(ALPHA), spot),
    }
    return {title: panel[wide] for title, panel in panels.items()}


def recolouring() -> dict[str, Tensor]:
    """Recolouring of a red motorcycle to blue."""
    image, scale = scene("motorcycle", SIZE)
    colours, painted = strokes(image, scale, ((350, 205, 40, 20), BLUE))
    edited = recolor(image, colours, painted)
    return {
        "A stroke of blue": painted_over(image, colours, painted),
        "What it reaches": reached(image, edited),
        "recolor": edited,
    }


def colourising() -> dict[str, Tensor]:
    """Colourisation of a grey photograph of a cup of coffee from a few strokes."""
    image, scale = scene("coffee", SIZE)
    painted = spots(image, scale, *TRUE)
    grey = luminance(image)
    return {
        "Strokes on a grey photograph": painted_over(grey, image, painted),
        "colorize": colorize(grey, image * painted, painted),
        "As it was in colour": image,
    }


def focusing() -> dict[str, Tensor]:
    """Defocus behind a portrait."""
    image, scale = scene("astronaut", SIZE)
    image = image[..., : round(image.shape[-1] / WIDE), :]
    region = spots(image, scale, *SUBJECT)
    return {
        "Spots to stay sharp": marked(image, region),
        "What stays sharp": default_map(image, region),
        "defocus": defocus(image, region),
    }


def abstraction() -> dict[str, Tensor]:
    """Abstraction of a photograph of a cat."""
    image = scene("chelsea", SIZE)[0]
    return {
        "A photograph": image,
        "abstract": abstract(image),
        "with lines and tones": abstract(image, edges=0.8, tones=8),
    }


def front() -> Tensor:
    """Two photographs with scribbles, each beside its result: recoloured, and out of focus behind the subject."""
    bike, scale = scene("motorcycle", 741)
    colours, painted = strokes(bike, scale, ((350, 205, 40, 20), BLUE))
    portrait = scene("astronaut", 512)[0][..., :346, :]
    subject = spots(portrait, 1.0, *SUBJECT)
    yellow = torch.tensor(YELLOW).view(1, 3, 1, 1)
    rows = [
        (scribbled(bike, colours, painted), recolor(bike, colours, painted)),
        (scribbled(portrait, yellow, subject), defocus(portrait, subject)),
    ]
    panels = [[F.pad(resize(panel.clamp(0, 1), FRONT), (GAP, GAP, GAP, GAP), value=1) for panel in row] for row in rows]
    return torch.cat([torch.cat(row, dim=3) for row in panels], dim=2).clamp(0, 1)


EDITS: dict[str, Callable[[], dict[str, Tensor]]] = {
    "detail": detail,
    "recolor": recolouring,
    "colorize": colourising,
    "defocus": focusing,
    "abstract": abstraction,
}


def main(arguments: list[str] | None = None) -> None:
    """Write a picture for every edit."""
    parser = argparse.ArgumentParser(description="Write the pictures of edits for the documentation.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs"), help="folder for the pictures")
    folder = parser.parse_args(arguments).folder
    folder.mkdir(exist_ok=True)
    for name, panels in EDITS.items():
        save_figure(show_images(panels(), columns=3, side=SIDE, letters=LETTERS), folder / f"edit-{name}.png")
    write_photograph(Photograph(front()), folder / "front.jpg")


if __name__ == "__main__":
    main()
