"""Values read from JSON: parsing with clear errors, checks, and how messages show them."""

import json
import reprlib
from typing import Protocol, TypeGuard, runtime_checkable

#: The value of a parameter of an edit; JSON has lists in place of tuples.
Value = float | str | tuple[float, ...] | None


def parse_json(text: str | bytes, name: str, remedy: str) -> object:
    """Parse the content of the file ``name``, in UTF-8, UTF-16 or UTF-32 if it is given as bytes.

    Raises:
        ValueError: if it is not JSON, names an entry twice, or is too deeply nested for Python.
    """
    twice: list[str] = []

    def entries(pairs: list[tuple[str, object]]) -> dict[str, object]:
        unique = dict(pairs)
        if len(unique) < len(pairs):
            names = [key for key, _ in pairs]
            twice.append(next(key for key in names if names.count(key) > 1))
        return unique

    try:
        content: object = json.loads(text, object_pairs_hook=entries)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else f"it is not JSON ({error})"
        raise ValueError(f"{name} is not a preset: {reason}; {remedy}") from error
    if twice:
        raise ValueError(f"{name} must have each entry once, got {shown(twice[0])} twice; remove one of them")
    return content


def shown(value: object) -> str:
    """Format a value for a message, as JSON if it is of such a type, and shortened if it is long or deeply nested.

    >>> shown({"a": None}), shown([0] * 100)
    ('{"a": null}', '[0, 0, 0, 0, 0, 0, ...]')
    """
    short = reprlib.repr(value)
    try:
        text = json.dumps(value)
    except (RecursionError, TypeError):
        return short
    return text if len(text) <= 80 else short


def is_within(value: object, low: float, high: float) -> TypeGuard[float]:
    """Whether a JSON value is a number in a closed, finite range; NaN is not."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


@runtime_checkable
class SupportsItem(Protocol):
    """A number of numpy."""

    def item(self) -> float:
        """The number of Python that equals it."""


def without_numpy(value: Value) -> Value:
    """The value with numbers of Python in place of those of numpy, which JSON does not take.

    >>> from numpy import float32, int64
    >>> without_numpy(float32(0.5)), without_numpy((int64(2), 1.0)), without_numpy("auto")
    (0.5, (2, 1.0), 'auto')
    """
    if isinstance(value, tuple):
        if all(type(entry) is float for entry in value):  # quicker than the protocol, for long lists
            return value
        return tuple(entry.item() if isinstance(entry, SupportsItem) else entry for entry in value)
    return value.item() if isinstance(value, SupportsItem) else value
