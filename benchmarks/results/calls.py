"""Calls of everything public, and of it with wrong inputs: a digest of the value, or the error."""

import inspect
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

import nlfilter_torch
import nlfilter_torch.photo
from benchmarks.results import edits, functions, modules, photographs, refusals
from benchmarks.results.digests import Digest, of_text, of_value

Call = Callable[[], object]


def results() -> Iterator[tuple[str, Digest]]:
    """The results of all calls, by their names, with those of all public names."""
    packages = (nlfilter_torch, nlfilter_torch.photo)
    public = {name: getattr(package, name) for package in packages for name in sorted(package.__all__)}
    names = sorted(public)
    yield "public names", list(names)
    yield from ((f"arguments of {name}", arguments(public[name])) for name in names if callable(public[name]))
    called: set[str] = set()
    for dtype in (torch.float32, torch.float64):
        for part in (functions, edits, modules):
            for name, call in part.calls(dtype).items():
                called.add(name.partition(":")[0])
                yield f"{name}, {dtype}", of_call(call)
    yield "public names without a call", [name for name in names if name not in called]
    yield from ((name, of_call(call)) for name, call in photographs.calls().items())


def wrong() -> Iterator[tuple[str, Digest]]:
    """The errors for wrong inputs, by their names."""
    yield from ((name, of_call(call)) for name, call in refusals.calls().items())


def of_call(call: Call) -> Digest:
    """Digest of what a call returns and warns of, or its error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            value = of_value(call())
        except Exception as error:
            return {"error": f"{type(error).__name__}: {of_text(str(error))}"}
    notes: list[Digest] = [of_text(str(note.message)) for note in caught if issubclass(note.category, UserWarning)]
    return {"value": value, "notes": notes}


def arguments(called: Any) -> list[Digest]:
    """The arguments of a function or class, with their kinds and defaults."""
    return [
        f"{argument.name} {argument.kind.name} {shown(argument.default)}"
        for argument in inspect.signature(called).parameters.values()
    ]


def shown(default: Any) -> str:
    """A default as text; of a path only the name, since files may move, and nothing of other objects."""
    if isinstance(default, Path):
        return default.name
    return repr(default) if type(default).__module__ == "builtins" else type(default).__name__
