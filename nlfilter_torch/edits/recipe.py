"""A whole edit as a small JSON file: sliders, strokes and the settings of every step, for any photograph.

What the editor saves and ``nlfilter-torch apply`` takes. Sizes are shares of the picture and strokes lie where they lie
in it, so that an edit that was made on a preview holds for the photograph. The steps come in the order of
:attr:`Recipe.steps`, each from what the one before made, and those that change nothing are left out.
"""

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from torch import Tensor

from nlfilter_torch.edits.presets import Preset, find_preset, parse_json, shown
from nlfilter_torch.edits.scribbles import Stroke
from nlfilter_torch.edits.steps import NONE, Abstract, Colorize, Defocus, Detail, Recolor, Step


@dataclass(frozen=True)
class Recipe:
    """An edit of a photograph, step by step; as it comes, it changes nothing."""

    detail: Detail = field(default_factory=Detail)
    colorize: Colorize = field(default_factory=Colorize)
    recolor: Recolor = field(default_factory=Recolor)
    defocus: Defocus = field(default_factory=Defocus)
    abstract: Abstract = field(default_factory=Abstract)

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps, in their order."""
        return (self.detail, self.colorize, self.recolor, self.defocus, self.abstract)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all steps, in their order."""
        return tuple(STEPS)

    @property
    def landmarks(self) -> int:
        """The largest number of landmarks of any step, at least the default, for an estimate of the memory needed."""
        return max(self.detail.landmarks, 200 if self.abstract.changes() else 100)

    @property
    def factors(self) -> int:
        """Arrays as large as a factor that the hungriest step holds at once; patches in colour count as one."""
        return 2 if self.detail.has_region() else 1

    def apply(self, image: Tensor) -> Tensor:
        """Edit a photograph.

        Args:
            image: (1, C, H, W) in [0, 1], C = 1 or 3.

        Returns:
            (1, C, H, W), with C = 3 if it was coloured; the image itself if no step changes it. Values may leave
            [0, 1].

        Raises:
            ValueError: if a step cannot do its work on such an image.

        Example:
            >>> import torch
            >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
            >>> recipe = Recipe(Detail(alpha=(3.0, 1.0), inside=(1.0, 1.0)), abstract=Abstract(edges=1.0))
            >>> recipe.apply(image).shape, Recipe().apply(image) is image
            (torch.Size([1, 3, 24, 24]), True)
        """
        result = image
        for step in self.steps:
            if step.changes():
                result = step.apply(image if result is image else result.clamp(0, 1))
        return result

    def to_json(self) -> str:
        """The edit as text; a plain preset where that says it all, so that ``detail --preset`` takes it too.

        >>> print(Recipe(defocus=Defocus((Stroke(((0.5, 0.5),), 0.1, "in"),))).to_json())
        {
          "defocus": {
            "strokes": [
              {"paint": "in", "radius": 0.1, "points": [[0.5, 0.5]]}
            ],
            "radius": 2.5
          }
        }
        <BLANKLINE>
        """
        steps = {name: step for name, step in zip(STEPS, self.steps, strict=True) if step.changes()}
        if set(steps) <= {"detail"} and not self.detail.strokes:
            return self.detail.preset.to_json()
        blocks = [f'  "{name}": {{\n{_lines(step)}\n  }}' for name, step in steps.items()]
        return "{\n" + ",\n".join(blocks) + "\n}\n"

    @staticmethod
    def from_json(text: str, name: str) -> "Recipe":
        """Read what :meth:`to_json` or :meth:`Preset.to_json` wrote; what is left out has its default.

        Args:
            text: the file's content.
            name: what errors call it.

        Raises:
            ValueError: if ``text`` is no JSON object, or an entry is unknown or not of its kind.
        """
        entries = parse_json(text, name, "save one in the editor")
        if isinstance(entries, dict) and "alpha" in entries:
            return Recipe(Detail.of(Preset.from_json(text, name)))
        if not isinstance(entries, dict) or not set(entries) <= set(STEPS):
            raise ValueError(
                f"{name} is no preset: it must hold steps out of {', '.join(STEPS)}; save one in the editor"
            )
        return Recipe(**{step: _read(STEPS[step], value, f"{step} in {name}") for step, value in entries.items()})

    @staticmethod
    def find(name: str) -> "Recipe":
        """The preset of that name, or the edit in the file at that path.

        Raises:
            ValueError: if there is neither, or the file holds none.
        """
        path = Path(name)
        if path.is_file():
            return Recipe.from_json(path.read_text(encoding="utf-8", errors="replace"), name)
        return Recipe(Detail.of(find_preset(name)))


STEPS: dict[str, Any] = {
    "detail": Detail,
    "colorize": Colorize,
    "recolor": Recolor,
    "defocus": Defocus,
    "abstract": Abstract,
}


def _lines(step: Any) -> str:
    """The entries of a step, a line for each, and a line for each stroke."""
    lines = []
    for entry in fields(step):
        value = getattr(step, entry.name)
        if entry.name == "strokes":
            strokes = ",\n".join(f"      {json.dumps(stroke.entries())}" for stroke in value)
            lines.append(f'    "strokes": [\n{strokes}\n    ]' if value else '    "strokes": []')
        else:
            lines.append(f'    "{entry.name}": {json.dumps(value)}')
    return ",\n".join(lines)


def _read(kind: Any, entries: Any, place: str) -> Any:
    """A step from what JSON holds."""
    if not isinstance(entries, dict):
        raise ValueError(f"{place} must hold entries in braces, got {shown(entries)}; correct it")
    values: dict[str, Any] = {}
    for entry, value in entries.items():
        if entry == "strokes" and kind.PAINTS:
            if not isinstance(value, list):
                raise ValueError(f"strokes of {place} must be a list, got {shown(value)}; correct them")
            values[entry] = tuple(Stroke.from_entries(stroke, kind.PAINTS, place) for stroke in value)
            continue
        if entry not in kind.VALID:
            known = [*kind.VALID, *(["strokes"] if kind.PAINTS else [])]
            raise ValueError(f"{place} must hold no other entries than {', '.join(known)}, got {entry}; remove it")
        wanted, is_valid = kind.VALID[entry]
        if not is_valid(value):
            raise ValueError(f"{entry} of {place} must be {wanted}, got {shown(value)}; correct it")
        values[entry] = tuple(map(float, value)) if isinstance(value, list) else value
    if kind is Detail:
        values.setdefault("alpha", NONE)
        values.setdefault("inside", (1.0,) * len(values["alpha"]))
        if len(values["inside"]) != len(values["alpha"]):
            raise ValueError(f"inside of {place} must have as many numbers as alpha; add or drop some")
    return kind(**values)
