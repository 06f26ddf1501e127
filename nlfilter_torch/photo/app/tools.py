"""The tools of the canvas: the brush, and the frame of the crop, which ``static/crop.js`` lets a person drag."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from nicegui import ui

from nlfilter_torch.photo.declared.declaration import GRADIENTS
from nlfilter_torch.photo.declared.development import WHOLE_CROP, Crop
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.strokes import WORDS, Mark, Region, Shape, Stroke

PALETTE = ("#2f6fde", "#12a15f", "#e0b321", "#dd5c21", "#c8283c", "#8a46c8", "#8b5e3c", "#808080")
BRUSH_RADIUS = 0.02  # of the brush at the start
BRUSHES: dict[str, dict[str, str]] = {
    edit.name: {word: label for scribble in edit.scribbles for word, label in scribble.tools.items()}
    for edit in EDITS.values()
    if edit.scribbles
}
FREE, ORIGINAL = "Free", "Original"
#: Width and height of the crops that a person may choose.
SIDES = {f"{wide}:{high}": (wide, high) for wide, high in ((1, 1), (3, 2), (2, 3), (4, 3), (3, 4), (16, 9), (9, 16))}
PROPORTIONS = (FREE, ORIGINAL, *SIDES)
EDGES = ("left", "top", "right", "bottom")
CORNERS = ("top left", "top right", "bottom right", "bottom left")


@dataclass
class Brush:
    """The settings of the brush, for each step.

    Attributes:
        word: meaning of the strokes; ``colour`` in it stands for :attr:`colour`.
        radius: as a share of the short side.
        colour: for all steps that take one.
        shown: what is called with the colour when it changes: the fields that show it.
    """

    word: dict[str, str] = field(default_factory=lambda: {step: next(iter(words)) for step, words in BRUSHES.items()})
    radius: dict[str, float] = field(default_factory=lambda: dict.fromkeys(BRUSHES, BRUSH_RADIUS))
    colour: str = PALETTE[0]
    shown: list[Callable[[str], object]] = field(default_factory=list)

    def paint(self, step: str) -> str:
        """The meaning or colour of a stroke for a step."""
        return self.word[step].split(": ")[-1].replace("colour", self.colour)

    def drags(self, step: str) -> Shape | None:
        """The shape that is drawn from where dragging begins to where it ends; None draws a stroke."""
        if self.word[step].startswith(WORDS["box"]):
            return "rectangle"
        return next((shape for shape in GRADIENTS if self.word[step].startswith(f"{shape}: ")), None)

    def mark(self, step: str, points: Sequence[tuple[float, float]]) -> Mark:
        """What is drawn along points (x, y), in shares of the picture."""
        shape = self.drags(step)
        if shape is None:
            return Stroke(tuple(points), self.radius[step], self.paint(step))
        return Region.dragged(points[0], points[-1], shape, self.paint(step))

    def choose_colour(self, value: object) -> None:
        """Set the colour, if the value is one, such as ``#2f6fde``; what is typed may be incomplete."""
        if not (isinstance(value, str) and len(value) == 7 and value.startswith("#")) or value.lower() == self.colour:
            return
        self.colour = value.lower()
        for show in self.shown:
            show(self.colour)


@dataclass
class Proportions:
    """The proportions that a crop keeps while it is dragged.

    A crop that is cut to them begins with the last one that a person has made, however often they are changed.

    Attributes:
        name: one of :data:`PROPORTIONS`.
        cut: the last crop that was cut to them.
        base: the one that it was cut from.
        kept: the crops that were made with them.
    """

    name: str = FREE
    cut: Crop | None = None
    base: Crop = WHOLE_CROP
    kept: frozenset[Crop] = frozenset()

    def aspect(self, size: tuple[int, int]) -> float | None:
        """The width of a crop of a photograph (H, W) by its height, or None for any.

        >>> [Proportions(name).aspect((100, 150)) for name in ("Free", "Original", "16:9")]
        [None, 1.5, 1.7777777777777777]
        """
        if self.name == FREE:
            return None
        wide, high = size[::-1] if self.name == ORIGINAL else SIDES[self.name]
        return wide / high

    def begin(self, crop: Crop) -> Crop:
        """The crop to cut from, if the current one is ``crop``."""
        if crop != self.cut:
            self.base = crop
        return self.base

    def follow(self, crop: Crop) -> None:
        """Let any crop be dragged from now on if the current one, ``crop``, was not made with these proportions."""
        if crop not in self.kept:
            self.name = FREE


class CropTool:
    """The photograph without a crop, and the frame of the crop over it, built into the open element."""

    def __init__(self) -> None:
        with ui.element("div").classes("cropper") as self._tool, ui.element("div").classes("crop-picture"):
            ui.element("img").classes("uncropped").props('alt="the whole photograph"')
            with ui.element("div").classes("crop-frame").props('role="group" aria-label="Crop"'):
                for corner in CORNERS:
                    ui.element("div").classes(f"crop-corner {corner}").props('aria-hidden="true"')
                for edge in EDGES:
                    handle = ui.element("div").classes(f"crop-edge {edge}").props('role="slider" tabindex="0"')
                    handle.props(f'aria-label="{edge.capitalize()} edge" aria-valuemin="0" aria-valuemax="100"')
                    handle.props(f'aria-valuenow="0" data-edge="{edge}"')
        self._tool.set_visibility(False)

    def show(self, address: str, size: tuple[int, int], edges: Sequence[float], aspect: float | None) -> None:
        """Show the picture at an address, (height, width) in size, and a frame.

        ``aspect`` is the width that the frame keeps by its height, each as a share of that of the picture, or None.
        """
        self._tool.set_visibility(True)
        ui.run_javascript(
            f"cropper.show('{address}', {size[1]}, {size[0]}, {json.dumps(list(edges))}, {json.dumps(aspect)})"
        )

    def hide(self) -> None:
        """Hide it."""
        self._tool.set_visibility(False)
        ui.run_javascript("cropper.hide()")
