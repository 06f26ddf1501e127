"""Sliders and the filter they belong to, as a small JSON file: an edit that was found once, for any other photograph.

Names and units are those of the command line, so that the file can be read and changed by hand.
"""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any


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
        try:
            entries = json.loads(text)
        except ValueError as error:
            raise ValueError(
                f"{name} is no preset: it is not JSON ({error}); make one with nlfilter-torch fit"
            ) from error
        if not isinstance(entries, dict) or "alpha" not in entries:
            raise ValueError(f"{name} is no preset: it has no entry alpha; make one with nlfilter-torch fit")
        for entry, value in entries.items():
            if entry not in ENTRIES:
                raise ValueError(f"{name} must hold no other entries than {', '.join(ENTRIES)}, got {entry}; remove it")
            wanted, is_valid = ENTRIES[entry]
            if not is_valid(value):
                raise ValueError(f"{entry} in {name} must be {wanted}, got {json.dumps(value)}; correct it")
        return Preset(**entries | {"alpha": tuple(map(float, entries["alpha"]))})


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


# What each entry must be, in words and as a test.
ENTRIES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "alpha": (
        "a list of at least two numbers",
        lambda v: isinstance(v, list) and len(v) > 1 and all(map(_is_number, v)),
    ),
    "bandwidth": ('a positive number of grey levels or "auto"', lambda v: v == "auto" or (_is_number(v) and v > 0)),
    "spatial_bandwidth": ("a positive number of pixels or null", lambda v: v is None or (_is_number(v) and v > 0)),
    "patch_size": ("an odd positive number", lambda v: _is_count(v) and v % 2 == 1),
    "landmarks": ("a positive number", _is_count),
    "sampling": ('"kmeans", "uniform" or "random"', lambda v: v in ("kmeans", "uniform", "random")),
}
