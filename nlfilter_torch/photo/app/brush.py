"""The brush of the editor: which strokes it draws for each edit."""

from collections.abc import Callable
from dataclasses import dataclass, field

from nlfilter_torch.photo.declared.parameters import EDITS

PALETTE = ("#2f6fde", "#12a15f", "#e0b321", "#dd5c21", "#c8283c", "#8a46c8", "#8b5e3c", "#808080")
BRUSH_RADIUS = 0.02  # of the brush at the start
BRUSHES: dict[str, dict[str, str]] = {
    edit.name: {scribble.word: scribble.label for scribble in edit.scribbles if scribble.role != "box"}
    for edit in EDITS.values()
    if edit.scribbles
}


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
        return self.word[step].replace("colour", self.colour)

    def choose_colour(self, value: object) -> None:
        """Set the colour, if the value is one, such as ``#2f6fde``; what is typed may be incomplete."""
        if not (isinstance(value, str) and len(value) == 7 and value.startswith("#")) or value.lower() == self.colour:
            return
        self.colour = value.lower()
        for show in self.shown:
            show(self.colour)
