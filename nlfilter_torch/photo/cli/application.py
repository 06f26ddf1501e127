"""The assembled command line, and how it reports invalid input.

Of a command line that typer refuses it says what was probably meant: names that other programs use, and slips that
explain themselves. Does not import torch, so that errors in options appear at once.
"""

import errno
import math
import re
import reprlib
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from nlfilter_torch.core.instruction_sets import NAMES, level, load_library
from nlfilter_torch.photo.cli.commands import apply, batch, demo, develop, fit, frames, inspect, presets
from nlfilter_torch.photo.cli.edits import command
from nlfilter_torch.photo.cli.mask import mask
from nlfilter_torch.photo.cli.process import INTERRUPTED, tell
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.version import __version__

NAME = "nlfilter-torch"
FULL = (errno.ENOSPC, errno.EDQUOT)
DEVELOP_OPTIONS = ("--exposure", "--temperature", "--tint", "--straighten", "--crop", "--aspect")  # options of develop
#: What other programs call an option: our options, of which those of the command are named, or a sentence.
OTHER_NAMES: Mapping[str, tuple[str, ...] | str] = {
    "--sigma": ("--noise-level", "--bandwidth", "--radius", "--tolerance"),
    "--noise": ("--noise-level",),
    "--denoise": "nlfilter-torch denoise IN OUT is a command of its own",
    "--sharpen": "nlfilter-torch sharpen IN OUT is a command of its own",
    "--h": ("--noise-level", "--bandwidth"),
    "--blur": ("--radius", "--guide-blur"),
    "--radius": ("--guide-blur", "--spatial-bandwidth", "--reach"),
    "--size": ("--patch-size", "--viewing-size"),
    "--amount": ("--strength", "--alpha", "--contrast"),
    "--strength": ("--amount", "--alpha", "--contrast"),
    "--intensity": ("--strength", "--amount", "--alpha"),
    "--gain": ("--alpha", "--amount", "--contrast"),
    "--sliders": ("--alpha",),
    "--detail": ("--alpha",),
    "--clarity": ("--alpha", "--amount"),
    "--color": ("--region X,Y,W,H:COLOUR", "--strokes", "--colour"),
    "--colour": ("--region X,Y,W,H:COLOUR", "--strokes"),
    "--chroma": ("--colour",),
    "--luminance": ("--brightness",),
    "--stroke": ("--strokes", "--region"),
    "--scribbles": ("--strokes", "--region"),
    "--roi": ("--region",),
    "--foreground": ("--region",),
    "--exclude": ("--background", "--keep", "--remove"),
    "--brush": ("--add",),
    "--include": ("--add", "--region"),
    "--erase": ("--remove",),
    "--subtract": ("--remove",),
    "--connected": ("--extent object",),
    "--contiguous": ("--extent object",),
    "--everywhere": ("--extent everywhere",),
    "--levels": ("--tones",),
    "--bits": ("--depth",),
    "--jobs": ("--workers",),
    "--threads": "all cores are used; OMP_NUM_THREADS=1 in the environment sets another number of threads",
    "--recursive": "nlfilter-torch batch IN_DIR OUT_DIR edits one folder, without those in it",
    "--output": "the output is the second argument: nlfilter-torch COMMAND IN OUT",
    "--input": "the photograph is the first argument: nlfilter-torch COMMAND IN OUT",
    "--overwrite": ("--force",),
    "--yes": ("--force",),
    **{option: (option,) for option in DEVELOP_OPTIONS},
    "--brightness": ("--exposure",),
    "--wb": ("--temperature", "--tint"),
    "--white-balance": ("--temperature", "--tint"),
    "--rotate": ("--straighten",),
    "--ratio": ("--aspect",),
    "--proportions": ("--aspect",),
    "--resize": "photographs keep their size",
    "--gpu": "the commands work on the processor; the functions of the library take tensors on any device",
    "--device": "the commands work on the processor; the functions of the library take tensors on any device",
    "--verbose": "progress is printed to standard error without an option",
    "--quiet": "redirect standard error to silence progress: 2>/dev/null",
}
#: What other programs call a command: ours, with an option if it has several purposes.
OTHER_COMMANDS: Mapping[str, str] = {
    "crop": "develop IN OUT --crop L,T,R,B",
    "straighten": "develop IN OUT --straighten DEGREES",
    "rotate": "develop IN OUT --straighten DEGREES",
    "exposure": "develop IN OUT --exposure STOPS",
    "brightness": "develop IN OUT --exposure STOPS",
    "white-balance": "develop IN OUT --temperature T --tint T",
    "contrast": "tone IN OUT --contrast FACTOR",
    "enhance": "detail IN OUT --preset crisp",
    "clarity": "detail IN OUT --preset crisp",
    "noise": "denoise IN OUT",
    "smooth": "denoise IN OUT",
    "blur": "defocus IN OUT --region X,Y,W,H",
    "bokeh": "defocus IN OUT --region X,Y,W,H",
    "select": "mask IN OUT --region X,Y,W,H",
    "segment": "mask IN OUT --region X,Y,W,H",
    "color": "recolor IN OUT --region X,Y,W,H:COLOUR",
    "colour": "recolor IN OUT --region X,Y,W,H:COLOUR",
    "recolour": "recolor IN OUT --region X,Y,W,H:COLOUR",
    "colourise": "colorize IN OUT --region X,Y,W,H:COLOUR",
    "colourize": "colorize IN OUT --region X,Y,W,H:COLOUR",
    "cartoon": "abstract IN OUT",
    "lut": "apply IN OUT --preset FILE.cube",
    "video": "frames FILM OUT",
    "edit": "app IN",
    "gui": "app IN",
    "open": "app IN",
}
SHORT: Mapping[str, str] = {
    "-o": "--output",
    "-i": "--input",
    "-s": "--sigma",
    "-q": "--quality",
    "-j": "--jobs",
    "-t": "--threads",
    "-f": "--overwrite",
    "-y": "--yes",
    "-r": "--recursive",
    "-v": "--verbose",
    "-m": "--mask",
    "-p": "--preset",
}
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)")
IMAGE = re.compile(r".*\.(png|jpe?g|tiff?|webp|avif|heic|dng|nef|cr2|arw|bmp|gif)", re.IGNORECASE)


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
            context = getattr(error, "ctx", None)  # of the command that the error is about
            own = [] if context is None else [name for parameter in context.command.params for name in parameter.opts]
            return _refuse(explained(message, arguments, own))
        except OSError as error:
            return _refuse(_sentence(error))
        except (ValueError, MemoryError) as error:  # a bad file or value, found by the library
            return _refuse(str(error))
    if status == INTERRUPTED:
        return tell()
    return status if isinstance(status, int) else 0


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


def explained(message: str, arguments: Sequence[str], options: Collection[str]) -> str:
    """A message of typer, with what was probably meant.

    Args:
        message: of the error.
        arguments: of the command line.
        options: of the command, such as ``--alpha``.

    >>> explained("No such option: --sigma (Possible options: --mask)", ["denoise"], ["--noise-level", "--bandwidth"])
    'No such option: --sigma; here it is --noise-level or --bandwidth'
    >>> explained("No such command 'in.jpg'.", ["in.jpg", "out.jpg"], [])[:50]
    "No such command 'in.jpg'; the command comes first,"
    """
    option = re.match(r"No such option: (-\S+)", message)
    if option is not None:
        meant = _meant(option[1], options)
        return f"No such option: {option[1]}; {meant}" if meant else message
    command = re.match(r"No such command '(.*)'\.", message)
    if command is not None and IMAGE.fullmatch(command[1]):
        return (
            f"No such command '{command[1]}'; the command comes first, such as nlfilter-torch detail "
            f"{command[1]} OUT --preset crisp, and nlfilter-torch --help lists all of them"
        )
    if command is not None:
        ours = OTHER_COMMANDS.get(command[1].lower())
        here = "" if ours is None else f"here it is nlfilter-torch {ours}, and "
        return f"No such command '{command[1]}'; {here}nlfilter-torch --help lists all of them"
    if message.startswith("Got unexpected extra argument"):
        return message + _of_extra(arguments)
    return message


def _meant(option: str, options: Collection[str]) -> str:
    """What was meant by an option that a command does not have, or nothing."""
    name = SHORT.get(option, option)
    meanings = OTHER_NAMES.get(name, ())
    if isinstance(meanings, str):
        return meanings
    own = [meaning for meaning in ((name,) if name in options else meanings) if meaning.split()[0] in options]
    if own:
        return f"here it is {' or '.join(own[:2])}"
    if any(meaning in DEVELOP_OPTIONS for meaning in meanings):
        return f"nlfilter-torch develop has {', '.join(DEVELOP_OPTIONS[:-1])} and {DEVELOP_OPTIONS[-1]}"
    return "nlfilter-torch batch has --workers" if "--workers" in meanings else ""


def _of_extra(arguments: Sequence[str]) -> str:
    """The end of a message on too many arguments."""
    for option, *values in zip(arguments, arguments[1:], arguments[2:], strict=False):
        if option.startswith("--") and all(map(NUMBER.fullmatch, values)):
            return f"; the numbers of {option} are separated by commas: {option} 2,2,2,1"
    pictures = [argument for argument in arguments[1:] if IMAGE.fullmatch(argument)]
    if len(pictures) >= 2:
        return "; the command edits one photograph, and nlfilter-torch batch IN_DIR OUT_DIR all of a folder"
    return ""
