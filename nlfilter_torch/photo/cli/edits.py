"""One command per edit, with options generated from the declaration of its parameters."""

import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.declared.declaration import FILTER_PANEL, UNITS, Edit, Parameter
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step

#: Options of detail that do not concern regions.
DETAIL_OPTIONS = tuple(p.name for p in EDITS["detail"] if p.is_option and p.name not in ("reach", "tolerance"))
TYPES = {"number": float, "count": int, "odd": int, "sliders": str}


def plain_step(recipe: Recipe) -> Step | None:
    """The only step of a recipe, if options of ``detail`` can express it."""
    step = recipe.steps[0] if len(recipe.steps) == 1 else None
    return step if step is not None and step.edit == "detail" and not step.strokes else None


def typed_options(context: typer.Context, names: Iterable[str]) -> list[str]:
    """Those of these options that are on the command line, even if with their default values."""
    sources = {name: context.get_parameter_source(name) for name in names}
    return [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]


def other_recipe(context: typer.Context, preset: str, names: Iterable[str]) -> Recipe | None:
    """The recipe of a preset, if options of ``detail`` cannot express it; ValueError if parameters are given too."""
    recipe = find_recipe(preset)
    if plain_step(recipe) is not None:
        return None
    if given := typed_options(context, names):
        raise ValueError(
            f"--{given[0].replace('_', '-')} must not be given with a --preset of edits other than detail, got "
            f"{preset}; leave it out, or set it in that file"
        )
    return recipe


def look_step(recipe: Recipe) -> Step | None:
    """The only step of a recipe, if it is a look."""
    return recipe.steps[0] if [step.edit for step in recipe.steps] == ["look"] else None


def preset_option(help: str, *, plain: bool = True) -> Any:
    """An option for a preset, whose values replace the defaults of other options.

    If ``plain``, presets must be a look or a single step of detail without strokes.
    """

    def use(context: typer.Context, name: str | None) -> str | None:
        step = None if name is None else plain_step(find_recipe(name))
        if step is not None:
            context.default_map = {entry: option_value(step.declared[entry], value) for entry, value in step.values}
        elif plain and name is not None and look_step(find_recipe(name)) is None:
            raise ValueError(
                f"--preset must hold a look or a single detail step without strokes, got {name}; "
                "use nlfilter-torch apply, which accepts any edit"
            )
        return name

    return typer.Option(metavar="NAME|FILE", callback=use, is_eager=True, help=help)


PresetName = Annotated[
    str | None,
    preset_option(
        f"One of {', '.join(PRESETS)} (see `nlfilter-torch presets`), or a file written by `nlfilter-torch fit`. It "
        "replaces the defaults of the other options; options on the command line override it."
    ),
]
#: Options for scribbles, regions and masks, by the name of the edit.
SCRIBBLES: dict[str, dict[str, Any]] = {
    "detail": {"preset": PresetName, "region": options.SliderRegions, "mask": options.MaskFile, "show": options.Show},
    "recolor": {
        "strokes": options.StrokesFile,
        "region": options.ColourRegions,
        "keep": options.Keeps,
        "show": options.Show,
    },
    "denoise": {"map": options.NoiseMap},
    "colorize": {"strokes": options.StrokesFile, "region": options.ColourRegions, "show": options.Show},
    "defocus": {
        "region": options.Regions,
        "background": options.Backgrounds,
        "mask": options.MaskFile,
        "show": options.Show,
    },
    "mask": {
        "region": options.Regions,
        "background": options.Backgrounds,
        "mask": options.MaskFile,
        "show": options.Show,
    },
}


def option_value(parameter: Parameter, value: Any) -> Any:
    """Convert the value of a parameter to that of its option.

    >>> option_value(EDITS["detail"]["alpha"], (3.0, 1.05)), option_value(EDITS["tone"]["bandwidth"], 20.0)
    ('3,1.05', '20')
    """
    if parameter.kind == "sliders":
        return ",".join(f"{slider:.9g}" for slider in value)
    return f"{value:.9g}" if parameter.words and isinstance(value, int | float) else value


def option(parameter: Parameter, panel: str | None = None) -> Any:
    """The annotation of a parameter's option; ``panel`` replaces the title of its section in the help."""
    kind: Any = Literal[parameter.choices] if parameter.choices else TYPES[parameter.kind]
    limits: dict[str, Any] = {}
    if parameter.words:
        kind = str
    elif parameter.kind in ("number", "count"):
        limits = {"min": kind(parameter.low), "max": kind(parameter.high)}
    elif parameter.kind == "odd":
        limits = {"max": int(parameter.high)}
    decorated = typer.Option(
        f"--{parameter.name.replace('_', '-')}",
        metavar=None if parameter.choices else parameter.metavar or UNITS[parameter.unit][1],
        help=parameter.help,
        rich_help_panel=panel or parameter.panel,
        **limits,
    )
    return Annotated[kind | None if parameter.optional else kind, decorated]


def _argument(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _declared(parameter: Parameter, panel: str | None = None) -> inspect.Parameter:
    return _argument(parameter.name, option(parameter, panel), option_value(parameter, parameter.default))


def signature(edit: Edit, *, target: Any = options.Target, depth: Any = options.OutputDepth) -> inspect.Signature:
    """The signature of an edit's command; ``target`` and ``depth`` annotate its output and the depth of that."""
    return inspect.Signature(
        [
            _argument("source", options.Source, inspect.Parameter.empty),
            _argument("target", target, inspect.Parameter.empty),
            *(_argument(name, annotation, None) for name, annotation in SCRIBBLES.get(edit.name, {}).items()),
            *(_declared(p) for p in edit if p.is_option),
            _argument("depth", depth, None),
            _argument("seed", options.Seed, 0),
            _argument("memory", options.Memory, None),
            _argument("full", options.Full, False),
            _argument("workers", options.Workers, None),
            _argument("cluster", options.Cluster, None),
        ]
    )


def with_options(*names: str, more: Iterable[Edit] = ()) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace ``**given`` of a command with the named options of detail and all options of the edits in ``more``."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        found = inspect.signature(function, eval_str=True).parameters.values()
        own = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in found if p.kind != p.VAR_KEYWORD]
        added = {name: _declared(EDITS["detail"][name]) for name in names}
        for edit in more:
            for parameter in edit:
                if parameter.is_option and parameter.name not in added:
                    added[parameter.name] = _declared(parameter, f"Options of {edit.name}")
        signature = inspect.Signature([*own, *added.values()])
        setattr(function, "__signature__", signature)  # noqa: B010  # read by typer; unknown to mypy
        return function

    return decorate


def command(edit: Edit) -> Callable[..., None]:
    """Create the command of an edit."""

    def run(source: str, target: str, *, context: typer.Context, **given: Any) -> None:
        edit_photograph(edit.name, source, target, typed=typed_options(context, given), **given)

    run.__name__, run.__doc__ = edit.name, edit.help
    found = signature(edit)
    whole = [*found.parameters.values(), _argument("context", typer.Context, inspect.Parameter.empty)]
    run.__signature__ = found.replace(parameters=whole)  # type: ignore[attr-defined]  # read by typer
    run.__annotations__ = {}
    return run


def step_of(edit: Edit, given: dict[str, Any]) -> Step:
    """Create a step from options, without its scribbles."""
    values = {}
    for parameter in edit:
        if parameter.name not in given:
            continue
        value = given[parameter.name]
        if parameter.kind == "sliders":
            value = options.parse_sliders(value, f"--{parameter.name}")
        elif parameter.words or (parameter.kind == "number" and isinstance(value, str)):
            value = value if value is None else options.parse_number(value, parameter)
        elif parameter.kind == "odd":
            options.check_odd(value, parameter)
        values[parameter.name] = value
    return Step(edit.name, **values)


def edit_photograph(
    name: str,
    source: str,
    target: str,
    *,
    depth: options.FileDepth | None = None,
    seed: int = 0,
    memory: float | None = None,
    full: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    typed: Iterable[str] = (),
    **given: Any,
) -> None:
    """Apply an edit, given by name, to a file.

    ``given`` are options of its command, by default those of the edit, and ``typed`` are the names of those that the
    user gave.
    """
    edit = EDITS[name]
    step = step_of(edit, given)
    preset = given.get("preset")
    if preset is not None and (look := look_step(find_recipe(preset))) is not None:
        if {"region", "mask", *(parameter.name for parameter in edit)}.intersection(typed):
            raise ValueError(
                f"--preset must not be combined with other options of detail if it is a look, got {preset}; drop them"
            )
        edit, step, name = EDITS["look"], look, "look"

    import torch
    from torch import Tensor

    from nlfilter_torch.nn.denoiser.noise import Noise
    from nlfilter_torch.photo.cli import editing, scribbles, showing
    from nlfilter_torch.photo.cli.editing import Job
    from nlfilter_torch.photo.cli.noise import MAP_DEPTH, NoiseReport, squared_difference, write_map
    from nlfilter_torch.photo.edits.applying import apply_to, check_channels, fit_step
    from nlfilter_torch.photo.edits.noise import noise_of
    from nlfilter_torch.photo.io.photographs import Photograph, check_type
    from nlfilter_torch.photo.io.rows import StoredPicture, open_picture
    from nlfilter_torch.photo.picture.in_memory import InMemory
    from nlfilter_torch.photo.picture.source import Source, seeded
    from nlfilter_torch.photo.tiled.pictures import Picture, stored_as
    from nlfilter_torch.photo.tiled.source import Tiled
    from nlfilter_torch.photo.tiled.tiles import Tiling
    from nlfilter_torch.photo.tiled.workers import single_threaded

    def tell(drawn: tuple[tuple[Any, ...], dict[str, Any]], size: tuple[int, int], read: showing.Read) -> None:
        """Print what scribbles cover and what is left out, and write the picture of ``--show``."""
        channels = read(slice(0, 1)).shape[1]
        check_channels(name, channels)
        if channels == 1:
            showing.note_grey([step], source)
        if given.get("show") is not None and not any(True for _ in showing.overlays(drawn)):
            raise ValueError("--show needs scribbles; give --region X,Y,W,H, or omit --show")
        showing.tell_colours(showing.overlays(drawn), read)
        if given.get("show") is not None:
            showing.show(given["show"], name, step.arguments, size, read, drawn)

    def measured(named: dict[str, Any], picture: Source, read: showing.Read) -> NoiseReport:
        """Estimate the noise unless it is given, write its map if requested, and return its report."""
        level = step.arguments(picture.size)["noise_level"]
        if level is None:
            named["noise_level"] = noise_of(picture)
        found = named.get("noise_level") or Noise.even(torch.as_tensor([level]))
        if given.get("map") is not None:
            write_map(found, picture.size, read, given["map"])
        return NoiseReport(found, given=level is not None, strength=step["strength"])

    def work(photograph: Photograph) -> Tensor:
        free = editing.allowed_memory(memory)
        with ExitStack() as files:

            def read(path: Path) -> StoredPicture:
                return files.enter_context(open_picture(path, free))

            def rows_of(part: slice) -> Tensor:
                return photograph.pixels[..., part, :]

            drawn = scribbles.of_edit(step, photograph.size, given, read)
            tell(drawn, photograph.size, rows_of)
            noise = measured(drawn[1], InMemory(photograph.pixels), rows_of) if name == "denoise" else None
            marked = scribbles.at_once(*drawn)
            if name == "colorize":
                showing.note_colours(source, photograph.size, rows_of)
            edited = apply_to(step, photograph.pixels, *marked, generator=seeded(seed))
            if noise is not None:
                kind = options.DEPTHS[depth] if depth else photograph.depth  # the difference of the files is reported
                noise.add(squared_difference(stored_as(photograph.pixels, photograph.depth), stored_as(edited, kind)))
                noise.tell()
            return edited

    @contextmanager
    def by_rows(job: Job) -> Iterator[Tiling]:
        tiled = Tiled(
            Picture(job.picture.rows, source),
            job.passes(full, Path(target).parent),
            str(given.get("strokes") or "--region"),
        )
        drawn = scribbles.of_edit(step, job.size, given, job.open)

        def rows_of(part: slice) -> Tensor:
            return tiled.picture.tile(part.start, part.stop, 0).pixels

        tell(drawn, job.size, rows_of)
        noise = measured(drawn[1], tiled, rows_of) if name == "denoise" else None
        with single_threaded(tiled.passes.workers(1)):
            fitted = fit_step(step, tiled, *drawn, generator=seeded(seed))
        if name == "colorize":
            showing.note_colours(source, job.size, rows_of)
        with tiled.tiling(fitted) as tiling:
            yield tiling if noise is None else noise.watched(tiling)
        if noise is not None:
            noise.tell()

    selected = given.get("region") or given.get("mask")
    if not (edit.requires_strokes or selected or step.changes()):
        options.note(f"{name} changes nothing with these options: the photograph is written as it is")
    if name == "denoise" and step["method"] == "network":
        for parameter in edit:
            if parameter.panel == FILTER_PANEL and parameter.name in typed:
                option = f"--{parameter.name.replace('_', '-')}"
                options.note(f"{option} has no effect on the network; add --method rule to denoise by the filter alone")
    read = {what: given.get(what) for what in ("mask", "strokes", "preset")}
    editing.check_apart("OUT", target, **read)
    for which in ("show", "map"):
        editing.check_apart(f"--{which}", given.get(which), photograph=source, output=target, **read)
    if given.get("map") is not None:
        check_type(given["map"], MAP_DEPTH, alpha=False)
    masked = name == "detail" and bool(selected)
    editing.edit_file(
        source,
        target,
        depth,
        work,
        bytes_per_pixel=step.bytes_per_pixel(masked=masked),
        memory=memory,
        by_rows=by_rows,
        coloured=edit.coloured,
        workers=workers,
        cluster=cluster,
    )
