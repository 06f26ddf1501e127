"""The brush of the editor: which strokes it draws for each edit."""

from dataclasses import dataclass, field

from nlfilter_torch.photo.declared.parameters import EDITS

COLOURS = ("#2f6fde", "#12a15f", "#e0b321", "#dd5c21", "#c8283c", "#8a46c8", "#8b5e3c", "#808080")
BRUSHES: dict[str, dict[str, str]] = {
    edit.name: {scribble.word: scribble.label for scribble in edit.scribbles}
    for edit in EDITS.values()
    if edit.scribbles
}


@dataclass
class Brush:
    """The settings of the brush, for each step.

    Attributes:
        word: meaning of the strokes; ``colour`` stands for :attr:`colour`.
        radius: as a share of the short side.
        colour: for all steps that take one.
    """

    word: dict[str, str] = field(default_factory=lambda: {step: next(iter(words)) for step, words in BRUSHES.items()})
    radius: dict[str, float] = field(default_factory=lambda: dict.fromkeys(BRUSHES, 0.02))
    colour: str = COLOURS[0]

    def paint(self, step: str) -> str:
        """The meaning or colour of a stroke for a step."""
        return self.colour if self.word[step] == "colour" else self.word[step]

    def choose_colour(self, value: object) -> None:
        """Set the colour, if the value is one, such as ``#2f6fde``; what is typed may be incomplete."""
        if isinstance(value, str) and len(value) == 7 and value.startswith("#"):
            self.colour = value.lower()
