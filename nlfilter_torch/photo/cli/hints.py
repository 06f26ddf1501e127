"""What is said of a command line that typer refuses: names that other programs use, and slips that explain themselves.

Does not import torch, so that errors in options appear at once.
"""

import re
from collections.abc import Collection, Mapping, Sequence

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
    "--box": ("--region",),
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
