"""Recipes: an ordered list of steps, each with its parameters and strokes, as a small JSON file; and the named presets.

The editor saves, and ``nlfilter-torch apply`` and ``batch`` read::

    {
      "version": 1,
      "develop": {"exposure": 0.5, "straighten": 1.5},
      "steps": [
        {"edit": "denoise"},
        {"edit": "detail", "alpha": [2.0, 2.0, 2.0, 1.0]}
      ]
    }

Omitted entries have the defaults of the command of that name. A step may also have ``"on": false``, which switches it
off, and ``"opacity"`` from 0 to 1, which mixes its result with the picture before it. Coordinates of strokes are
relative to the picture as it is before it is developed, so that an edit made on a preview applies to the photograph,
and strokes stay in place when the crop changes. Does not import torch.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.declared.colour_tables import lattice_of_cube, lattice_of_hald
from nlfilter_torch.photo.declared.development import AS_IT_IS, Development, Frame
from nlfilter_torch.photo.declared.json_values import Value, parse_json, shown
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.steps import VERSION, Step, acting_steps, json_of
from nlfilter_torch.photo.declared.strokes import Region

if TYPE_CHECKING:
    from nlfilter_torch.photo.declared.colour_tables import Values

EDIT_ORDER = tuple(EDITS)  # order in which the editor adds steps
JPEG_START = b"\xff\xd8\xff"
PICTURE_STARTS = (b"\x89PNG", b"II*\0", b"MM\0*", JPEG_START)  # how files of pictures start
OTHER_PICTURES = (b"BM", b"RIFF", b"GIF8", b"P6", b"\0\0\0")  # of kinds that are not read here
TEXT_STARTS = ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"", "utf-8-sig"))  # how files of text start
DEVELOPING_BYTES = 48  # per pixel: three copies in colour with transparency; 41 were measured
REMEDY = "save one in the editor"


@dataclass(frozen=True)
class Recipe:
    """An edit of a photograph as a sequence of steps; without steps it changes nothing.

    Attributes:
        steps: each applied to the result of the one before; of any kind, in any order, and any number of times.
        develop: exposure, white balance, straightening and crop, which come before all steps. Strokes are in
            coordinates of the picture before that.
        chosen: place of the step that the editor's controls show where there are several of its edit; None is the last
            of them. It is not part of the edit; comparisons ignore it.
    """

    steps: tuple[Step, ...] = ()
    develop: Development = AS_IT_IS
    chosen: int | None = field(default=None, compare=False, repr=False)

    @property
    def acting(self) -> tuple[Step, ...]:
        """The steps that have an effect."""
        return acting_steps(self.steps)

    @property
    def changes(self) -> bool:
        """Whether the recipe has any effect."""
        return bool(self.acting) or not self.develop.is_idle

    @property
    def effect(self) -> tuple[Development, tuple[Step, ...]]:
        """All that the result depends on; recipes of the same effect give the same picture."""
        return self.develop, self.acting

    def on_developed(self, size: tuple[int, int], seen: tuple[int, int] | None = None) -> "Recipe":
        """The steps for the picture (H, W) that has been developed: their strokes are mapped to what it shows.

        Strokes that the crop leaves out are dropped; a step without others of the objects that it changes has no
        effect, or no region. ``seen`` is the size of the developed picture where it is reduced.
        """
        frame = self.develop.frame(size)
        return Recipe(tuple(on_frame(step, frame, seen) for step in self.steps))

    def cropped_away(self, size: tuple[int, int]) -> list[tuple[int, Step]]:
        """The steps, by their numbers from 1, that have no effect or no region on a picture (H, W) due to the crop."""
        steps = zip(self.steps, self.on_developed(size).steps, strict=True)
        return [
            (number, step)
            for number, (step, mapped) in enumerate(steps, 1)
            if step.changes() and step.is_drawn() and not mapped.marks_object()
        ]

    def check_crop(self, size: tuple[int, int], name: str) -> None:
        """Raise ValueError if the crop is outside the photograph (H, W); ``name`` is the file's name in the message."""
        try:
            self.develop.frame(size)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error

    @property
    def drawn(self) -> "Recipe":
        """The recipe without the steps that would have no effect if they were on, and have no strokes."""
        return self._of(tuple(step for step in self.steps if step.would_change() or step.strokes))

    def choosing(self, place: int) -> "Recipe":
        """The same recipe, of which the step at a place is edited."""
        return replace(self, chosen=place)

    def current(self, edit: str) -> Step:
        """Return the step of an edit at :meth:`place_of`, or one that changes nothing if there is none."""
        place = self.place_of(edit)
        return Step.idle(edit) if place is None else self.steps[place]

    def with_current(self, step: Step) -> "Recipe":
        """Replace the current step of the same edit, or insert the step at its usual place if there is none."""
        place = self.place_of(step.edit)
        if place is not None:
            return self.replaced(place, step)
        rank = EDIT_ORDER.index(step.edit)
        place = max((i + 1 for i, other in enumerate(self.steps) if EDIT_ORDER.index(other.edit) < rank), default=0)
        return self._of((*self.steps[:place], step, *self.steps[place:]), self._after(place, 1))

    def place_of(self, edit: str) -> int | None:
        """The place of the chosen step if it is one of that edit, or else of the last one, or None."""
        places = [place for place, step in enumerate(self.steps) if step.edit == edit]
        return self.chosen if self.chosen in places else max(places, default=None)

    def replaced(self, place: int, *steps: Step) -> "Recipe":
        """Replace the step at a place by others, or by none."""
        chosen = self._after(place + 1, len(steps) - 1) if steps or self.chosen != place else None
        return self._of((*self.steps[:place], *steps, *self.steps[place + 1 :]), chosen)

    def _after(self, place: int, by: int) -> int | None:
        """The place of the chosen step if the steps from a place on move."""
        return self.chosen if self.chosen is None or self.chosen < place else self.chosen + by

    def moved(self, place: int, to: int) -> "Recipe":
        """Move the step at a place to another.

        >>> [step.edit for step in Recipe((Step("tone"), Step("sharpen"), Step("denoise"))).moved(0, 2).steps]
        ['sharpen', 'denoise', 'tone']
        """
        order = [other for other in range(len(self.steps)) if other != place]
        order.insert(to, place)
        chosen = None if self.chosen is None else order.index(self.chosen)
        return self._of(tuple(self.steps[other] for other in order), chosen)

    def _of(self, steps: tuple[Step, ...], chosen: int | None = None) -> "Recipe":
        """A recipe of other steps, developed alike."""
        return replace(self, steps=steps, chosen=chosen)

    @property
    def bytes_per_pixel(self) -> int:
        """Memory in bytes per pixel of the step that needs most."""
        developing = 0 if self.develop.is_idle else DEVELOPING_BYTES
        return max((step.bytes_per_pixel() for step in self.acting), default=0) + developing

    @property
    def gives_colour(self) -> bool:
        """Whether a grey photograph becomes one in colour."""
        return any(step.declared.coloured for step in self.acting)

    def to_json(self, *, drawn: bool = False, complete: bool = False) -> str:
        """Format the recipe as JSON, without defaults, and without steps that change nothing even if they are on.

        Args:
            drawn: whether to keep the steps that change nothing but have strokes.
            complete: whether to write all steps, with their defaults, so that they can be edited by hand.

        Example:
            >>> print(Recipe((Step("tone"), Step("detail", alpha=(2.0, 1.0)))).to_json())
            {
              "version": 1,
              "steps": [
                {
                  "edit": "tone",
                  "contrast": 1.2
                },
                {
                  "edit": "detail",
                  "alpha": [2.0, 1.0]
                }
              ]
            }
            <BLANKLINE>
        """
        used = tuple(step for step in self.steps if step.would_change())
        steps = self.steps if complete else self.drawn.steps if drawn else used
        develop = "" if self.develop.is_idle else self.develop.to_json("  ", complete=complete)
        return json_of(steps, develop, complete=complete)

    @staticmethod
    def from_json(text: str | bytes, name: str, remedy: str = REMEDY) -> "Recipe":
        """Parse the output of :meth:`to_json`.

        Raises:
            ValueError: if ``text`` is no JSON object, or an entry is unknown or invalid. ``name`` is the file's name in
                the message, which ends in ``remedy`` if the file is no recipe at all.
        """
        entries = parse_json(text, name, remedy)
        if not isinstance(entries, dict) or "steps" not in entries:
            raise ValueError(f"{name} is not a preset: it must hold a list of steps; {remedy}")
        steps = tuple(map(partial(_beside, Path(name).parent), _read_steps(entries, name)))
        return Recipe(steps, Development.from_entries(entries.get("develop", {}), name))

    @staticmethod
    @lru_cache(maxsize=4)  # a command asks for the file of an option more than once
    def from_file(content: bytes, name: str) -> "Recipe":
        """Parse a file of steps, as :meth:`from_json` does, or a colour table: a ``.cube`` file, or a Hald picture.

        Raises:
            ValueError: if it is neither. ``name`` is the file's name in the message.
        """
        if name.lower().endswith(".cube"):
            encoding = next(encoding for mark, encoding in TEXT_STARTS if content.startswith(mark))
            return Recipe((Step("look", lattice=lattice_of_cube(content.decode(encoding, "replace"), name)),))
        if content.startswith(PICTURE_STARTS):
            step = Step("look", lattice=lattice_of_hald(_decoded(content, name), name))
            if content.startswith(JPEG_START):
                warn(f"{name} is a Hald in a JPEG file, whose compression shifts the colours; save it as PNG")
            return Recipe((step,))
        if content.startswith(OTHER_PICTURES):
            raise ValueError(
                f"{name} must be a preset, a .cube file or a Hald, got a file of another kind; save a Hald as PNG"
            )
        return Recipe.from_json(content, name)


def on_frame(step: Step, frame: Frame, seen: tuple[int, int] | None = None) -> Step:
    """A step with its strokes in coordinates of the developed picture, without those that it does not show.

    ``seen`` is the size (h, w) of that picture where it is reduced. Strokes of a step whose objects miss the original
    itself remain, so that they are reported.
    """
    if frame.is_whole or not step.strokes:
        return step
    objects = step.objects
    misses = bool(objects) and not any(mark.reaches(frame.original) for mark in objects)
    strokes = map(frame.mark_inward, step.strokes)
    return step.changed(strokes=tuple(stroke for stroke in strokes if misses or stroke.reaches(seen or frame.size)))


def _beside(folder: Path, step: Step) -> Step:
    """A step whose pictures of marks lie in a folder, unless their paths are absolute."""
    if not any(isinstance(mark, Region) and mark.file for mark in step.strokes):
        return step
    return step.changed(
        strokes=tuple(
            replace(mark, file=str(folder.absolute() / mark.file)) if isinstance(mark, Region) and mark.file else mark
            for mark in step.strokes
        )
    )


def _decoded(content: bytes, name: str) -> "Values":
    """The pixels (H, W, C) of a picture, or (H, W)."""
    try:
        import imagecodecs
    except ImportError as error:
        raise ImportError(f"{name} is a picture, and reading it needs nlfilter-torch[cli]; install that") from error
    try:
        picture: Values = imagecodecs.imread(content)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be a Hald, got a picture that cannot be read; save it as PNG") from error
    return picture


def _read_steps(entries: dict[str, object], name: str) -> list[Step]:
    """Parse the steps of a file."""
    unknown = entries.keys() - {"version", "develop", "steps"}
    if unknown:
        raise ValueError(
            f"{name} must have no entries other than version, develop and steps, got {min(unknown)}; remove it"
        )
    if entries.get("version") != VERSION:
        raise ValueError(
            f"version in {name} must be {VERSION}, got {shown(entries.get('version'))}; "
            "update nlfilter-torch to read newer files"
        )
    if not isinstance(entries["steps"], list):
        raise ValueError(f"steps in {name} must be a list, got {shown(entries['steps'])}; correct it")
    steps = []
    for number, step in enumerate(entries["steps"], 1):
        if not isinstance(step, dict) or step.get("edit") not in EDIT_ORDER:
            raise ValueError(
                f"step {number} in {name} must have an entry edit, one of {', '.join(EDIT_ORDER)}, got {shown(step)}; "
                "correct it"
            )
        rest = {entry: value for entry, value in step.items() if entry != "edit"}
        steps.append(Step.from_entries(step["edit"], rest, f"{step['edit']}, step {number} in {name}"))
    return steps


def _detail(**values: Value) -> Recipe:
    """A recipe of a single step of ``detail``."""
    return Recipe((Step("detail", (), **values),))


#: The named presets. Chosen by eye on astronaut, chelsea and rocket of scikit-image and seven photographs of
#: landscapes, buildings and plants. The presets that remove grain work better without a spatial term.
PRESETS: dict[str, Recipe] = {
    "crisp": _detail(alpha=(2.2, 2.2, 2.2, 1.0)),
    "clear": _detail(alpha=(1.5, 1.5, 1.5, 1.0)),
    "texture": _detail(alpha=(2.5, 1.3, 1.0, 1.0)),
    "dramatic": _detail(alpha=(2.0, 2.5, 3.5, 1.0), bandwidth=40.0),
    "glow": _detail(alpha=(0.5, 1.0, 2.5, 1.0), bandwidth=40.0),
    "soft skin": _detail(alpha=(0.1, 0.4, 1.0, 1.0), bandwidth=8.0, spatial_bandwidth="none", landmarks=100),
    "calm": _detail(alpha=(0.8, 0.6, 0.4, 1.0), bandwidth=40.0),
    "smooth": _detail(alpha=(0.0, 0.0, 0.0, 1.0), bandwidth=12.0, spatial_bandwidth="none", landmarks=100),
}

#: Short descriptions of the :data:`PRESETS`.
PURPOSES: dict[str, str] = {
    "crisp": "stronger detail of all sizes",
    "clear": "slightly stronger detail of all sizes",
    "texture": "stronger finest detail only: fur, hair, cloth, stone, but also grain",
    "dramatic": "strong light and shade; small halos at hard edges",
    "glow": "softer fine detail, stronger large shapes",
    "soft skin": "removes pores and grain, keeps eyes and outlines",
    "calm": "less contrast within objects, as in haze",
    "smooth": "removes texture, keeps edges; a start for a drawing",
}


_GREY = (0.32, 0.52, 0.16)  # red, green and blue in a grey photograph; more red than luminance has keeps skin light
_SOFT_CONTRAST = (0.0, 0.215, 0.5, 0.785, 1.0)


def _look(red: tuple[float, ...], green: tuple[float, ...], blue: tuple[float, ...], factor: float = 1.0) -> Step:
    """A look of three curves and a factor of saturation."""
    return Step("look", red=red, green=green, blue=blue, saturation=(factor,) * 5)


#: The named looks, which are presets too: steps of ``look`` with tone curves and colours only, chosen by eye. The
#: editor shows them.
LOOKS: dict[str, Step] = {
    "vivid": _look(_SOFT_CONTRAST, _SOFT_CONTRAST, _SOFT_CONTRAST, 1.2),
    "warm": _look((0.0, 0.27, 0.54, 0.78, 1.0), (0.0, 0.25, 0.505, 0.755, 1.0), (0.0, 0.23, 0.46, 0.7, 0.96), 1.05),
    "cool": _look((0.0, 0.23, 0.465, 0.715, 0.97), (0.0, 0.245, 0.5, 0.75, 1.0), (0.015, 0.275, 0.54, 0.785, 1.0)),
    "faded": _look((0.08, 0.29, 0.51, 0.73, 0.95), (0.07, 0.28, 0.5, 0.72, 0.94), (0.09, 0.29, 0.5, 0.7, 0.9), 0.75),
    "mono": Step("look", matrix=_GREY * 3),  # curves, which act on each channel, would tint it
}

#: Short descriptions of the :data:`LOOKS`.
CHARACTERS: dict[str, str] = {
    "vivid": "more contrast and colour",
    "warm": "lighter, towards red and yellow",
    "cool": "slightly darker, towards blue",
    "faded": "lifted shadows, dimmed highlights, pale colours",
    "mono": "black and white, with light skin",
}


def named_recipe(name: str) -> Recipe | None:
    """Return the preset or look of that name, or None."""
    spoken = name.lower().replace("-", " ").replace("_", " ")
    if spoken in LOOKS:
        return Recipe((LOOKS[spoken],))
    return PRESETS.get(spoken)


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """The end of a message on a word that is none of these: the one that was probably meant, or nothing.

    >>> did_you_mean("vivd", ("vivid", "warm")), did_you_mean("x", ("vivid", "warm"))
    ('; did you mean vivid?', '')
    """
    close = get_close_matches(word.lower(), words, n=1)
    return f"; did you mean {close[0]}?" if close else ""


def find_recipe(name: str) -> Recipe:
    """Return the preset or look of that name (``soft-skin`` is ``soft skin``), or read the file at that path.

    It holds a recipe, or is a colour table of another program: a ``.cube`` file, or a Hald as a PNG or TIFF file.

    Raises:
        ValueError: if there is neither, or the file holds no recipe.

    Example:
        >>> find_recipe("soft-skin").steps[0]["alpha"]
        (0.1, 0.4, 1.0, 1.0)
    """
    named = named_recipe(name)
    if named is not None:
        return named
    path = Path(name)
    if not path.is_file():
        raise ValueError(
            f"{name} is neither a file nor one of the presets {', '.join((*PRESETS, *LOOKS))}"
            + (did_you_mean(name, (*PRESETS, *LOOKS)) or "; create a file with nlfilter-torch fit")
        )
    return Recipe.from_file(path.read_bytes(), name)
