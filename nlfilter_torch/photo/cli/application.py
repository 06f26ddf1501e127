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
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from nlfilter_torch.core.instruction_sets import NAMES, level, load_library
from nlfilter_torch.photo.cli.commands import apply, batch, demo, develop, fit, frames, inspect, presets
from nlfilter_torch.photo.cli.edits import command
from nlfilter_torch.photo.cli.mask import mask
from nlfilter_torch.photo.cli.process import INTERRUPTED, tell
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import did_you_mean, named_recipe
from nlfilter_torch.version import __version__

NAME = "nlfilter-torch"
FULL = (errno.ENOSPC, errno.EDQUOT)
DEVELOP_OPTIONS = (  # options of develop that other programs have everywhere
    *("--exposure", "--highlights", "--shadows", "--temperature", "--tint", "--saturation"),
    *("--rotate", "--straighten", "--crop", "--aspect"),
)
#: What other programs call an option: our options, of which those of the command are named, or a sentence.
OTHER_NAMES: Mapping[str, tuple[str, ...] | str] = {
    "--sigma": ("--noise-level", "--bandwidth", "--radius", "--tolerance"),
    "--noise": ("--noise-level",),
    "--denoise": "nlfilter-torch denoise IN OUT is a command of its own",
    "--sharpen": "nlfilter-torch sharpen IN OUT is a command of its own",
    "--sharpness": "nlfilter-torch sharpen IN OUT is a command of its own",
    "--cutout": "nlfilter-torch mask IN OUT --region X,Y,W,H --cutout FILE writes an object without its background",
    "--subject": ("--region", "--box"),
    "--auto": "regions are marked by hand, such as by --region X,Y,W,H",
    "--preset": "nlfilter-torch apply IN OUT NAME takes presets, looks and files of all edits",
    "--look": ("--preset",),
    "--lut": "nlfilter-torch apply IN OUT FILE.cube applies a colour table",
    "--h": ("--noise-level", "--bandwidth"),
    "--blur": ("--radius", "--guide-blur"),
    "--radius": ("--amount", "--spatial-bandwidth", "--reach"),
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
    "--wb": ("--temperature",),
    "--white-balance": ("--temperature",),
    "--kelvin": ("--temperature",),
    "--ev": ("--exposure",),
    "--ratio": ("--aspect",),
    "--proportions": ("--aspect",),
    "--gradient": ("--linear", "--radial"),
    **dict.fromkeys(
        ("--linear", "--radial", "--region", "--box", "--add"),
        "nlfilter-torch light changes a part of a photograph, such as light IN OUT --exposure -1 --linear 0,0,0,50%",
    ),
    "--resize": "photographs keep their size",
    "--width": "photographs keep their size",
    "--height": "photographs keep their size",
    "--gpu": "the commands work on the processor; the functions of the library take tensors on any device",
    "--device": "the commands work on the processor; the functions of the library take tensors on any device",
    "--help": "nlfilter-torch --help lists all commands, and nlfilter-torch COMMAND --help explains one",
    "--version": "nlfilter-torch --version prints the version",
    "--verbose": "progress is printed to standard error without an option",
    "--quiet": "redirect standard error to silence progress: 2>/dev/null",
}
#: What other programs call a command: ours, with an option if it has several purposes.
OTHER_COMMANDS: Mapping[str, str] = {
    "bw": "apply IN OUT mono",
    "monochrome": "apply IN OUT mono",
    "saturation": "develop IN OUT --saturation 0.3",
    "crop": "develop IN OUT --crop X,Y,W,H",
    "straighten": "develop IN OUT --straighten DEGREES",
    "rotate": "develop IN OUT --rotate 90",
    "exposure": "develop IN OUT --exposure STOPS",
    "brightness": "develop IN OUT --exposure STOPS",
    "white-balance": "develop IN OUT --temperature KELVIN --tint T",
    **dict.fromkeys(
        ("gradient", "vignette", "local", "dodge", "burn"), "light IN OUT --exposure STOPS --radial X,Y,W,H"
    ),
    **dict.fromkeys(("retouch", "inpaint", "clone", "spot", "spots"), "heal IN OUT --region X,Y,W,H"),
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
    "lut": "apply IN OUT FILE.cube",
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
    "-V": "--version",
    "-m": "--mask",
    "-p": "--preset",
}
HELP = {"help_option_names": ["-h", "--help"]}
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
    usual: dict[str, Any] = {"add_completion": False, "pretty_exceptions_enable": False, "context_settings": HELP}
    whole = typer.Typer(name=NAME, rich_markup_mode="markdown", **usual)
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
            context = getattr(error, "ctx", None)  # of the command that the error is about
            parameters = [] if context is None else context.command.params
            helps = {name: getattr(parameter, "help", "") for parameter in parameters for name in parameter.opts}
            return _refuse(explained(message, arguments, helps))
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


def explained(message: str, arguments: Sequence[str], options: Mapping[str, str]) -> str:
    """A message of typer, with what was probably meant.

    Args:
        message: of the error.
        arguments: of the command line.
        options: of the command, such as ``--alpha``, and their help.

    >>> helps = {"--noise-level": "Noise in grey levels. Default: measured.", "--mask": "A mask."}
    >>> explained("No such option: --sigma (Possible options: --mask)", ["denoise"], helps)
    'No such option: --sigma; here it is --noise-level (noise in grey levels)'
    >>> explained("No such command 'in.jpg'.", ["in.jpg", "out.jpg"], {})[:50]
    "No such command 'in.jpg'; the command comes first,"
    >>> explained("Invalid value for '--extent': 'objects' is not one of 'near', 'object'.", ["mask"], {})
    "Invalid value for '--extent': 'objects' is not one of 'near', 'object'; did you mean object?"
    """
    if option := re.match(r"No such option: (-\S+)", message):
        meant = _meant(option[1], options)
        return f"No such option: {option[1]}; {meant}" if meant else message
    if command := re.match(r"No such command '([^']*)'", message):
        return f"No such command '{command[1]}'; {_of_command(command[1], message)}"
    if choice := re.search(r"'([^']*)' is not one of (.*)\.$", message):
        return message[:-1] + did_you_mean(choice[1], re.findall(r"'([^']*)'", choice[2]))
    if number := re.match(r"Invalid value for '(--[^']*)'.* valid (number|integer), unable .*, got (.*)", message):
        kind = "an integer" if number[2] == "integer" else "a number"
        return f"{number[1]} must be {kind}, got {number[3]}{_first_sentence(options, number[1])}"
    if missing := re.match(r"Missing argument '([A-Z_]*)'", message):
        return f"{missing[0]}; nlfilter-torch {arguments[0]} --help shows what it is"
    if message.startswith("Got unexpected extra argument"):
        return message + _of_extra(arguments)
    return message


def _of_command(name: str, message: str) -> str:
    """What was meant by a command that does not exist, of which typer may propose others in its message."""
    if IMAGE.fullmatch(name):
        return (
            f"the command comes first, such as nlfilter-torch detail {name} OUT --preset crisp, and nlfilter-torch "
            "--help lists all of them"
        )
    if isinstance(sentence := OTHER_NAMES.get(f"--{name}"), str):
        return sentence
    ours, proposed = OTHER_COMMANDS.get(name.lower()), re.findall(r"'([^']*)'", message)[1:]
    if ours is None and named_recipe(name) is not None:
        ours = f"apply IN OUT {name}"
    meant = f"here it is nlfilter-torch {ours}, and " if ours else ""
    if proposed and not ours:
        meant = f"did you mean {' or '.join(proposed)}? "
    return f"{meant}nlfilter-torch --help lists all of them"


def _meant(option: str, options: Mapping[str, str]) -> str:
    """What was meant by an option that a command does not have, or nothing."""
    name = SHORT.get(option, option)
    meanings = OTHER_NAMES.get(name, ())
    if isinstance(meanings, str):
        return meanings
    own = [meaning for meaning in ((name,) if name in options else meanings) if meaning.split()[0] in options]
    if own:
        return f"here it is {' or '.join(own[:2])}" + ("" if own[1:] else _first_sentence(options, own[0]))
    if any(meaning in DEVELOP_OPTIONS for meaning in meanings):
        return f"nlfilter-torch develop has {', '.join(DEVELOP_OPTIONS[:-1])} and {DEVELOP_OPTIONS[-1]}"
    return "nlfilter-torch batch has --workers" if "--workers" in meanings else ""


def _first_sentence(options: Mapping[str, str], option: str) -> str:
    """What an option is, in parentheses, or nothing."""
    sentence = (options.get(option) or "").split(". ")[0].removesuffix(".")
    return f" ({sentence[0].lower()}{sentence[1:]})" if sentence else ""


def _of_extra(arguments: Sequence[str]) -> str:
    """The end of a message on too many arguments."""
    for option, *values in zip(arguments, arguments[1:], arguments[2:], strict=False):
        if option.startswith("--") and all(map(NUMBER.fullmatch, values)):
            return f"; the numbers of {option} are separated by commas: {option} 2,2,2,1"
    preset = next((argument for argument in arguments[1:] if named_recipe(argument) is not None), None)
    if preset is not None:
        return f"; nlfilter-torch apply IN OUT {preset} applies it"
    pictures = [argument for argument in arguments[1:] if IMAGE.fullmatch(argument)]
    if len(pictures) >= 2:
        return "; the command edits one photograph, and nlfilter-torch batch IN_DIR OUT_DIR all of a folder"
    return ""
