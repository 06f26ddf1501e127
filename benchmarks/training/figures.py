"""A figure with its limit, and the table of several."""

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A measured figure.

    Attributes:
        name: what was measured, in a few words.
        value: the measured value.
        limit: the value promised, or None for a figure that is only reported, such as that of a peer.
        unit: of both; empty for a ratio.
        at_most: whether the value must be at most the limit, or at least.
    """

    name: str
    value: float
    limit: float | None = None
    unit: str = ""
    at_most: bool = True

    @property
    def holds(self) -> bool:
        """Whether the value is finite, and keeps the limit if there is one."""
        if not math.isfinite(self.value):
            return False
        return self.limit is None or (self.value <= self.limit if self.at_most else self.value >= self.limit)


def table(figures: Iterable[Figure]) -> str:
    """A table of figures for the terminal, a line each."""
    lines = []
    for figure in figures:
        bound = "" if figure.limit is None else f"{'at most' if figure.at_most else 'at least'} {figure.limit:.4g}"
        verdict = "FALLS SHORT" if not figure.holds else "" if figure.limit is None else "holds"
        lines.append(f"{figure.name:<78} {figure.value:>10.4g} {figure.unit:<7} {bound:<18} {verdict}".rstrip())
    return "\n".join(lines)
