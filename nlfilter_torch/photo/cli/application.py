"""The assembled command line, and how it reports invalid input."""

import errno
import math
import reprlib
import sys
import warnings
from collections.abc import Callable, Iterable
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from nlfilter_torch.core.instruction_sets import NAMES, level, load_library
from nlfilter_torch.photo.cli.commands import apply, batch, demo, develop, frames, inspect, presets
from nlfilter_torch.photo.cli.edits import command
from nlfilter_torch.photo.cli.fit import fit
from nlfilter_torch.photo.cli.hints import explained
from nlfilter_torch.photo.cli.mask import mask
from nlfilter_torch.photo.cli.process import INTERRUPTED, tell
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.version import __version__

NAME = "nlfilter-torch"
FULL = (errno.ENOSPC, errno.EDQUOT)


class Verb(TyperCommand):
    """A command that shows out-of-range numbers in its errors, and rejects NaN and infinity."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; raise ValueError if an option is NaN or infinite, BadParameter if it is out of range."""
        original = list(args)
        try:
            rest = super().parse_args(ctx, args)
        except typer.BadParameter as error:
            if error.param is None or "Input should be" not in error.message:
                raise
            value = self.make_parser(ctx).parse_args(original)[0].get(error.param.name or "")
            if isinstance(value, str) and value.strip("+-").lower() in ("nan", "inf", "infinity"):
                value = float(value)
            _check_finite(error.param.opts[0], value)
            error.message += f", got {reprlib.repr(value)}"
            raise
        for parameter in self.params:
            _check_finite(parameter.opts[0], ctx.params.get(parameter.name))
        return rest


def _check_finite(option: str, value: object) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{option} must be a finite number, such as 1, got {value}")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{NAME} {__version__}, kernels in C: {NAMES[level(load_library())]}")
        raise typer.Exit


def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Print the version, and whether compiled kernels are used.",
        ),
    ] = False,
) -> None:
    """Edit photographs with a filter that treats similar places alike, wherever they are in the picture.

    It compares small patches from the whole picture and separates fine texture, larger details and shading, so that
    each can be made stronger or weaker. `nlfilter-torch COMMAND --help` explains each command.
    """


def assembled(others: Iterable[Callable[..., None]]) -> typer.Typer:
    """The command line, with other commands before its own."""
    whole = typer.Typer(name=NAME, add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)
    whole.callback()(_common)
    for verb in others:
        whole.command(cls=Verb)(verb)
    whole.command(cls=Verb)(develop)
    for edit in EDITS.values():
        whole.command(name=edit.name, cls=Verb)(command(edit))
    for verb in (mask, apply, fit, presets, batch, frames, inspect, demo):
        whole.command(cls=Verb)(verb)
    return whole


def run_program(arguments: list[str] | None, others: Iterable[Callable[..., None]]) -> int:
    """Run the command line and return its exit status: 2 after one sentence for invalid input, 130 for Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            status = assembled(others)(args=arguments or ["--help"], prog_name=NAME, standalone_mode=False)
        except typer.TyperException as error:  # a wrong option or argument
            message = error.format_message()
            if message.startswith("No such option: --preset"):
                message = "No such option: --preset; use nlfilter-torch detail or apply, which have it"
            return _refuse(explained(message, arguments, _options_of(error)))
        except OSError as error:
            return _refuse(_sentence(error))
        except (ValueError, MemoryError) as error:  # a bad file or value, found by the library
            return _refuse(str(error))
    if status == INTERRUPTED:
        return tell()
    return status if isinstance(status, int) else 0


def _options_of(error: typer.TyperException) -> list[str]:
    """The options of the command that an error is about."""
    context = getattr(error, "ctx", None)
    return [] if context is None else [name for parameter in context.command.params for name in parameter.opts]


def _sentence(error: OSError) -> str:
    """The library's own sentence, or one made of the system's code, file and message."""
    if error.strerror is None:
        return str(error)
    if error.errno in FULL:
        return f"{error.filename or 'the output'} cannot be written: {error.strerror}; free some space there"
    if error.filename is None:
        return f"reading or writing failed: {error.strerror}; check the disk, and try again"
    return f"{error.filename}: {error.strerror}; check the name and the permissions"


def _refuse(message: str) -> int:
    # Typer begins some messages with the class of the error.
    sentence = " ".join(message.replace("Value error, ", "").split())
    sys.stderr.write(f"{NAME}: {sentence}\n")
    return 2


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning without its location in the code."""
    sys.stderr.write(f"{NAME}: note: {message}\n")
