"""Calls that must be refused: errors are one sentence with argument, what it must be, what it was, and the remedy."""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

#: Of every sentence, which does not end in a full stop.
FORM = re.compile(r"[^\n]+ must .+, got .+; .+?([^.]|\.\.\.)")


class Refusal(NamedTuple):
    """A call that must raise an error whose sentence has a match of the pattern."""

    call: Callable[[], object]
    pattern: str
    error: type[Exception] = ValueError


#: Arguments that replace good ones, the pattern of the sentence, and the error if it is not a ValueError.
Row = tuple[Mapping[str, Any], str] | tuple[Mapping[str, Any], str, type[Exception]]


def refusals(function: Callable[..., object], good: Mapping[str, Any], *rows: Row) -> list[Refusal]:
    """Refusals of a function of good arguments, of which each row replaces some by wrong ones."""
    return [Refusal(_Call(function, {**good, **row[0]}), *row[1:]) for row in rows]  # type: ignore[misc]


class _Call(NamedTuple):
    function: Callable[..., object]
    arguments: Mapping[str, Any]

    def __call__(self) -> object:
        return self.function(**self.arguments)


def check_refusals(table: Iterable[Refusal]) -> None:
    """Make every call, and name all that are not refused as they must be."""
    faults = [fault for number, refusal in enumerate(table) if (fault := _fault(refusal, number))]
    assert not faults, "\n".join(faults)


def _fault(refusal: Refusal, number: int) -> str | None:
    wanted = f"{number}: {refusal.error.__name__} of {refusal.pattern!r}"
    try:
        refusal.call()
    except (TypeError, ValueError, LookupError) as error:
        said = str(error.args[0]) if error.args else ""
        if type(error) is not refusal.error or not re.search(refusal.pattern, said):
            return f"{wanted} was {error!r}"
        return None if FORM.fullmatch(said) else f"{wanted} is not one whole sentence: {said!r}"
    return f"{wanted} was taken"
