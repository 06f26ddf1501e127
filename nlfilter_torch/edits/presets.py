"""Sliders and the filter they belong to, as a small JSON file: an edit that was found once, for any other photograph.

Names and units are those of the command line, so that the file can be read and changed by hand. :data:`PRESETS` are
presets that have a name.
"""

import json
import reprlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch
    from torch import Tensor

#: Ranges of what presets and options hold: beyond them nothing useful is left, and numbers overflow.
GAINS = (-1e6, 1e6)  # of sliders
BANDWIDTHS = (0.01, 1e6)  # photometric, in grey levels of 255
DISTANCES = (0.01, 1e6)  # spatial bandwidths, in pixels
MAX_SLIDERS = 100
MAX_PATCH = 99  # pixels
MAX_LANDMARKS = 10_000


@dataclass(frozen=True)
class Preset:
    """An edit of the details of a photograph.

    Attributes:
        alpha: sliders, fine to coarse, at least two. Paper: eq. (12).
        bandwidth: photometric bandwidth in grey levels of 255, or ``"auto"``.
        spatial_bandwidth: in pixels, or None.
        patch_size: odd.
        landmarks: how many.
        sampling: ``"kmeans"``, ``"uniform"`` or ``"random"``.
    """

    alpha: tuple[float, ...]
    bandwidth: float | str = "auto"
    spatial_bandwidth: float | None = None
    patch_size: int = 5
    landmarks: int = 100
    sampling: str = "kmeans"

    def apply(self, image: "Tensor", *, generator: "torch.Generator | None" = None) -> "Tensor":
        """Edit a photograph as ``nlfilter-torch detail --preset`` does.

        Args:
            image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
            generator: source of randomness for the landmarks; None draws the same for every call.

        Returns:
            (B, C, H, W) in the image's dtype; values may leave [0, 1]. Differentiable in the image.

        Raises:
            TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an entry leaves its range.

        Example:
            >>> import torch
            >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
            >>> PRESETS["crisp"].apply(image).shape
            torch.Size([1, 3, 24, 24])
        """
        import torch

        from nlfilter_torch.edits.detail import enhance

        return enhance(image, torch.tensor(self.alpha), generator=generator, **self.options())

    def options(self) -> dict[str, Any]:
        """What :func:`nlfilter_torch.nonlocal_operator` takes, in units of the picture.

        >>> PRESETS["smooth"].options()["photometric_bandwidth"] * 255
        12.0
        """
        return {
            "photometric_bandwidth": self.bandwidth if isinstance(self.bandwidth, str) else self.bandwidth / 255,
            "spatial_bandwidth": self.spatial_bandwidth,
            "patch_size": self.patch_size,
            "num_landmarks": self.landmarks,
            "landmarks": self.sampling,
        }

    def to_json(self) -> str:
        """The preset as text, a line for each entry.

        >>> print(Preset((3.0, 1.0)).to_json())
        {
          "alpha": [3.0, 1.0],
          "bandwidth": "auto",
          "spatial_bandwidth": null,
          "patch_size": 5,
          "landmarks": 100,
          "sampling": "kmeans"
        }
        <BLANKLINE>
        """
        lines = [f'  "{name}": {json.dumps(value)}' for name, value in asdict(self).items()]
        return "{\n" + ",\n".join(lines) + "\n}\n"

    @staticmethod
    def from_json(text: str, name: str) -> "Preset":
        """Read what :meth:`to_json` wrote; entries that are left out have their defaults.

        Args:
            text: the file's content.
            name: what errors call it.

        Raises:
            ValueError: if ``text`` is no JSON object, or an entry is missing, unknown or not of its kind.
        """
        entries = parse_json(text, name, "make one with nlfilter-torch fit")
        if not isinstance(entries, dict) or "alpha" not in entries:
            raise ValueError(f"{name} is no preset: it has no entry alpha; make one with nlfilter-torch fit")
        for entry, value in entries.items():
            if entry not in ENTRIES:
                raise ValueError(f"{name} must hold no other entries than {', '.join(ENTRIES)}, got {entry}; remove it")
            wanted, is_valid = ENTRIES[entry]
            if not is_valid(value):
                raise ValueError(f"{entry} in {name} must be {wanted}, got {shown(value)}; correct it")
        return Preset(**entries | {"alpha": tuple(map(float, entries["alpha"]))})


#: The presets that have a name. Chosen by eye on astronaut, chelsea, coffee and rocket of scikit-image.
PRESETS: dict[str, Preset] = {
    "crisp": Preset((3.0, 3.0, 4.0, 1.05)),
    "clear": Preset((1.5, 1.7, 1.8, 1.0)),
    "texture": Preset((3.0, 1.5, 1.0, 1.0)),
    "dramatic": Preset((2.0, 3.0, 4.5, 0.95), 30.0),
    "glow": Preset((0.3, 1.0, 2.5, 1.06), 30.0),
    "soft skin": Preset((0.1, 0.4, 1.0, 1.0), 8.0),
    "calm": Preset((0.8, 0.6, 0.4, 1.0), 40.0),
    "smooth": Preset((0.0, 0.0, 0.0, 1.0), 12.0),
}

#: What each of :data:`PRESETS` does, in a few words.
PURPOSES: dict[str, str] = {
    "crisp": "all details, large and small, strongly",
    "clear": "a little more of everything",
    "texture": "the finest only: fur, hair, cloth, stone; grain too",
    "dramatic": "deep light and shade; dark corners go black",
    "glow": "fine detail soft, light and shade deep",
    "soft skin": "pores and grain away, eyes and outlines kept",
    "calm": "less contrast within things, as in haze",
    "smooth": "texture away, edges kept; the start of a drawing",
}


def find_preset(name: str) -> Preset:
    """The preset of that name (``soft-skin`` is ``soft skin``), or the one in the file at that path.

    Raises:
        ValueError: if there is neither, or the file holds no preset.

    Example:
        >>> find_preset("soft-skin").alpha
        (0.1, 0.4, 1.0, 1.0)
    """
    spoken = name.lower().replace("-", " ").replace("_", " ")
    if spoken in PRESETS:
        return PRESETS[spoken]
    path = Path(name)
    if not path.is_file():
        raise ValueError(
            f"{name} does not exist or is no file, nor is it one of the presets {', '.join(PRESETS)}; "
            "make a file with nlfilter-torch fit"
        )
    return Preset.from_json(path.read_text(encoding="utf-8", errors="replace"), name)


def parse_json(text: str, name: str, remedy: str) -> Any:
    """What the text of the file ``name`` holds.

    Raises:
        ValueError: if it is not JSON, or nested deeper than Python can follow.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else f"it is not JSON ({error})"
        raise ValueError(f"{name} is no preset: {reason}; {remedy}") from error


def shown(value: Any) -> str:
    """A value of JSON for a message, however long or deeply nested it is.

    >>> shown({"a": None}), shown([0] * 100)
    ('{"a": null}', '[0, 0, 0, 0, 0, 0, ...]')
    """
    short = reprlib.repr(value)
    try:
        text = json.dumps(value)
    except RecursionError:
        return short
    return text if len(text) <= 80 else short


def is_within(value: Any, low: float, high: float) -> bool:
    """Whether a value of JSON is a number in a range of finite ends; NaN is not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def is_count(value: Any, most: int) -> bool:
    """Whether a value of JSON is a whole number from 1 to ``most``."""
    return isinstance(value, int) and is_within(value, 1, most)


def is_sliders(value: Any) -> bool:
    """Whether a value of JSON is a list of sliders."""
    return isinstance(value, list) and 2 <= len(value) <= MAX_SLIDERS and all(is_within(v, *GAINS) for v in value)


# What each entry must be, in words and as a test.
ENTRIES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "alpha": (
        f"a list of 2 to {MAX_SLIDERS} numbers, none beyond {GAINS[1]:.0f}",
        is_sliders,
    ),
    "bandwidth": (
        f'a positive number of grey levels, from {BANDWIDTHS[0]:g} to {BANDWIDTHS[1]:.0f}, or "auto"',
        lambda v: v == "auto" or is_within(v, *BANDWIDTHS),
    ),
    "spatial_bandwidth": (
        f"a positive number of pixels, from {DISTANCES[0]:g} to {DISTANCES[1]:.0f}, or null",
        lambda v: v is None or is_within(v, *DISTANCES),
    ),
    "patch_size": (f"an odd number from 1 to {MAX_PATCH}", lambda v: is_count(v, MAX_PATCH) and v % 2 == 1),
    "landmarks": (f"a whole number from 1 to {MAX_LANDMARKS}", lambda v: is_count(v, MAX_LANDMARKS)),
    "sampling": ('"kmeans", "uniform" or "random"', lambda v: v in ("kmeans", "uniform", "random")),
}
