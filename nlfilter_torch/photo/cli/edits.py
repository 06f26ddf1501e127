"""One command per edit, with options generated from the declaration of its parameters."""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Annotated, Any, Literal

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.declared.declaration import FILTER_PANEL, UNIT_NAMES, Edit, Kind, Parameter
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import DETAIL
from nlfilter_torch.photo.declared.presets import LOOKS, PRESETS, Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step

Command = Callable[..., None]  # typer reads its signature
#: Options of detail that do not concern regions.
DETAIL_OPTIONS = tuple(p.name for p in DETAIL if p.is_option and p.name not in ("reach", "tolerance"))
NUMBERS: dict[Kind, type[float]] = {"number": float, "count": int, "odd": int}


def _only_step(recipe: Recipe) -> Step | None:
    """The only step of a recipe that holds nothing else, if it is on and opaque, which commands have no options for."""
    step = recipe.steps[0] if len(recipe.steps) == 1 and recipe.develop.is_idle else None
    return step if step is not None and step.on and step.opacity == 1 else None


def plain_step(recipe: Recipe) -> Step | None:
    """The only step of a recipe, if options of a command that takes presets can express it."""
    step = _only_step(recipe)
    return step if step is not None and step.declared.presets and not step.strokes else None


def typed_options(context: typer.Context, names: Iterable[str]) -> list[str]:
    """The options with these names that the user typed, even if with their default values."""
    sources = {name: context.get_parameter_source(name) for name in names}
    return [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]


def other_recipe(context: typer.Context, preset: str, names: Iterable[str]) -> Recipe | None:
    """The recipe of a preset, if options of ``detail`` cannot express it; ValueError if the user typed such options."""
    recipe = find_recipe(preset)
    if plain_step(recipe) is not None:
        return None
    if typed := typed_options(context, names):
        raise ValueError(
            f"--{typed[0].replace('_', '-')} must not be given with a --preset of edits other than detail or with "
            f"develop, got {preset}; leave it out, or set it in that file"
        )
    return recipe


def preset_step(recipe: Recipe, edit: Edit) -> Step | None:
    """The only step of a recipe, if the command of an edit takes it as it is."""
    step = _only_step(recipe)
    return step if step is not None and step.edit in edit.presets else None


def preset_option(help: str, *, plain: bool = True) -> object:
    """An option for a preset, whose values replace the defaults of other options.

    If ``plain``, presets must be a look or a single step of detail without strokes.
    """

    def use(context: typer.Context, name: str | None) -> str | None:
        step = None if name is None else plain_step(find_recipe(name))
        if step is not None:
            context.default_map = {entry: option_value(step.declared[entry], value) for entry, value in step.values}
        elif plain and name is not None and preset_step(find_recipe(name), DETAIL) is None:
            raise ValueError(
                "--preset must hold a look or a single detail step, without develop or strokes, switched on and at "
                f"full opacity, got {name}; use nlfilter-torch apply, which accepts any edit"
            )
        return name

    return typer.Option(metavar="NAME|FILE", callback=use, is_eager=True, help=help)


PresetName = Annotated[
    str | None,
    preset_option(
        f"One of {', '.join((*PRESETS, *LOOKS))} (see `nlfilter-torch presets`), or a file written by `nlfilter-torch "
        "fit`. It replaces the defaults of the other options; options on the command line override it, unless it is a "
        "look."
    ),
]


def scribble_options(edit: Edit) -> dict[str, object]:
    """The annotations of an edit's options for presets, scribbles, regions and masks, by their names."""
    kinds = [scribble.kind for scribble in edit.scribbles if scribble.role == "object"]
    annotations: dict[str, object] = {"preset": PresetName} if edit.presets else {}
    for kind in kinds:
        annotations |= {
            "strokes": options.StrokesFile,
            "region": options.rectangles("--region", *options.REGIONS[kind]),
        }
    for option in edit.with_options:
        metavar = option.metavar + options.REGIONS[option.scribble.kind][0].removeprefix("X,Y,W,H")
        if option.scribble.role == "box":  # which need not say a colour
            metavar = metavar.replace(":COLOUR", "[:COLOUR]")
        annotations[option.name.removeprefix("--")] = options.rectangles(option.name, metavar, option.help)
    if kinds:
        annotations["mask"] = options.MaskFile
    if "colours" in kinds:
        annotations["colour"] = options.Colour
        if not edit.coloured:
            annotations["source_colour"] = options.ColourRange
    if edit.scribbles:
        annotations["show"] = options.Show
    if edit.map_help:
        annotations["map"] = options.file("--map", edit.map_help)
    if edit.error_help:
        annotations["error_map"] = options.file("--error-map", edit.error_help)
    return annotations


def option_value(parameter: Parameter, value: Value) -> float | str | None:
    """Convert the value of a parameter to that of its option.

    >>> from nlfilter_torch.photo.declared.parameters import TONE
    >>> option_value(DETAIL["alpha"], (3.0, 1.05)), option_value(TONE["bandwidth"], 20.0)
    ('3,1.05', '20')
    """
    if isinstance(value, tuple):
        return ",".join(f"{slider:.9g}" for slider in value)
    return f"{value:.9g}" if parameter.words and isinstance(value, int | float) else value


def option(parameter: Parameter, panel: str | None = None) -> object:
    """The annotation of a parameter's option; ``panel`` replaces the title of its section in the help."""
    number = None if parameter.words else NUMBERS.get(parameter.kind)
    low = number(parameter.low) if number and parameter.kind != "odd" else None  # check_odd has a better error
    kind: Any = number or str  # typer reads annotations that are made here
    if parameter.choices and not parameter.words:
        kind = Literal[parameter.choices]
    decorated = typer.Option(
        f"--{parameter.name.replace('_', '-')}",
        metavar=None if parameter.choices else parameter.metavar or UNIT_NAMES[parameter.unit][1],
        help=parameter.help,
        rich_help_panel=panel or parameter.panel,
        min=low,
        max=number(parameter.high) if number else None,
    )
    return Annotated[kind | None if parameter.optional else kind, decorated]


def _argument(name: str, annotation: object, default: object) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _declared(parameter: Parameter, panel: str | None = None) -> inspect.Parameter:
    return _argument(parameter.name, option(parameter, panel), option_value(parameter, parameter.default))


def with_options(*names: str, more: Iterable[Edit] = ()) -> Callable[[Command], Command]:
    """Replace the ``**values`` of a command by the named options of detail and all options of the edits in ``more``."""

    def decorate(function: Command) -> Command:
        added = {name: _declared(DETAIL[name]) for name in names}
        for edit in more:
            for parameter in edit:
                if parameter.is_option and parameter.name not in added:
                    added[parameter.name] = _declared(parameter, f"Options of {edit.name}")
        return as_command(function, [*_own_parameters(function), *added.values()])

    return decorate


def with_declared(edit: Edit) -> Callable[[Command], Command]:
    """Replace the ``**values`` of a command by the options of an edit, and its help by that of the edit.

    An edit without a filter has no seed.
    """

    def decorate(function: Command) -> Command:
        source, target, *own = _own_parameters(function)
        if not any(parameter.panel == FILTER_PANEL for parameter in edit):
            own = [parameter for parameter in own if parameter.name != "seed"]
        marks = [_argument(name, annotation, None) for name, annotation in scribble_options(edit).items()]
        function.__name__, function.__doc__ = edit.name, edit.help
        return as_command(function, [source, target, *marks, *(_declared(p) for p in edit if p.is_option), *own])

    return decorate


def _own_parameters(function: Command) -> list[inspect.Parameter]:
    """The parameters of a command but its ``**values``, to be passed by name; of a dataclass, those of its fields."""
    parameters: list[inspect.Parameter] = []
    for own in inspect.signature(function, eval_str=True).parameters.values():
        if isinstance(own.annotation, type) and is_dataclass(own.annotation):
            parameters += inspect.signature(own.annotation, eval_str=True).parameters.values()
        elif own.kind != own.VAR_KEYWORD:
            parameters.append(own)
    return [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]


def as_command(function: Command, parameters: Sequence[inspect.Parameter]) -> Command:
    """The command of a function, with these options, of which it takes some as dataclasses."""
    own = inspect.signature(function, eval_str=True).parameters.values()
    grouped = {p.name: p.annotation for p in own if isinstance(p.annotation, type) and is_dataclass(p.annotation)}

    @wraps(function)
    def run(**values: Any) -> None:
        for name, kind in grouped.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        function(**values)

    run.__annotations__ = {}
    setattr(run, "__signature__", inspect.Signature(parameters))  # noqa: B010  # which typer reads; unknown to mypy
    return run


def command(edit: Edit) -> Command:
    """Create the command of an edit."""

    @with_declared(edit)
    def run(
        source: options.Source,
        target: options.Target,
        context: typer.Context,
        files: options.PhotographOptions,
        seed: options.Seed = 0,
        full: options.Full = False,
        **values: Any,
    ) -> None:
        typed = typed_options(context, values)
        edit_photograph(edit, source, target, files, typed=typed, seed=seed, full=full, **values)

    return run


def step_of(edit: Edit, options_of_edit: Mapping[str, Value]) -> Step:
    """Create a step from options, without its scribbles."""
    values: dict[str, Value] = {}
    for parameter in edit:
        if parameter.name not in options_of_edit:
            continue
        values[parameter.name] = parsed_value(options_of_edit[parameter.name], parameter)
    return Step(edit.name, (), **values)


def parsed_value(value: Any, parameter: Parameter) -> Any:
    """The value of an option, of which text stands for lists and for numbers that may be words.

    Raises:
        ValueError: if it is invalid; values that typer has checked are not checked again.
    """
    if isinstance(value, str) and parameter.kind == "sliders":
        return options.parse_sliders(value, f"--{parameter.name}")
    if isinstance(value, str) and (parameter.words or parameter.kind == "number"):
        return options.parse_number(value, parameter)
    if isinstance(value, int) and parameter.kind == "odd":
        options.check_odd(value, parameter)
    return value


def edit_photograph(
    edit: Edit,
    source: str,
    target: str,
    files: options.PhotographOptions,
    *,
    typed: Collection[str] = (),
    seed: int = 0,
    full: bool = False,
    **values: Any,
) -> None:
    """Apply an edit to a file.

    ``values`` are those of its parameters, of its preset, and of its options for scribbles, and ``typed`` holds the
    names of the options that the user typed.
    """
    preset, region = values.pop("preset", None), values.pop("region", None)
    strokes, mask = values.pop("strokes", None), values.pop("mask", None)
    # Of the options for scribbles only "colour" may also be the name of a parameter.
    colour = values.pop("colour", None) if "colour" in scribble_options(edit) else None
    source_colour = values.pop("source_colour", None)
    show, map, error_map = (values.pop(name, None) for name in ("show", "map", "error_map"))
    others = {option.name: values.pop(option.name.removeprefix("--"), None) for option in edit.with_options}
    step = step_of(edit, values)
    look = None if preset is None else preset_step(find_recipe(preset), edit)
    if look is not None:
        if {"region", "mask", *(parameter.name for parameter in edit)}.intersection(typed):
            raise ValueError(
                f"--preset must not be combined with other options of detail if it is a look, got {preset}; drop them"
            )
        step = look

    if not files.force:
        check_usual(step, typed, [options.split_region(text)[2] or "" for text in region or []])

    from nlfilter_torch.photo.cli.editing import check_written
    from nlfilter_torch.photo.cli.jobs import EditJob
    from nlfilter_torch.photo.cli.scribbles import ScribbleOptions

    rectangles = {name: texts for name, texts in others.items() if texts is not None}
    drawn = ScribbleOptions(region, strokes, mask, rectangles, colour, source_colour)
    check_written(source, target, show=show, map=map, error_map=error_map, mask=mask, strokes=strokes, preset=preset)
    notes = useless_options(step, typed, marked=drawn.marks_objects(edit))
    EditJob(source, target, files, full, step, drawn, show, map, error_map, seed, notes).run()


def check_usual(step: Step, typed: Collection[str], notes: Iterable[str] = ()) -> None:
    """Raise ValueError if an option that the user typed has a value that destroys pictures.

    Args:
        step: the step of the options.
        typed: names of the options that the user typed.
        notes: what follows rectangles of ``--region``; for edits of regions these are sliders.
    """
    for parameter in step.declared:
        if parameter.usual is None or parameter.name not in typed:
            continue
        _check_usual(f"--{parameter.name.replace('_', '-')}", step[parameter.name], parameter.usual)
    if step.declared.regional is not None:
        usual = step.declared["alpha"].usual
        for note in notes:
            if note and usual is not None:
                _check_usual("--region", options.parse_sliders(note, "--region"), usual)


def _check_usual(option: str, value: Value, usual: tuple[float, float]) -> None:
    numbers = value if isinstance(value, tuple) else (value,)
    if all(isinstance(number, int | float) and usual[0] <= number <= usual[1] for number in numbers):
        return
    shown = ",".join(f"{number:g}" if isinstance(number, int | float) else str(number) for number in numbers)
    raise ValueError(
        f"{option} must be from {usual[0]:g} to {usual[1]:g}, as other factors destroy the picture (1 changes nothing, "
        f"1.3 adds 30 %), got {shown}; choose another, or insist by --force"
    )


def useless_options(step: Step, typed: Collection[str], *, marked: bool) -> list[str]:
    """Notes if a step changes nothing, or options that the user typed have no effect."""
    edit, notes = step.declared, list[str]()
    if not (step.values_act if edit.requires_strokes else marked or step.changes()):
        notes.append(f"{edit.name} changes nothing with these options: the photograph is written without an edit")
    condition = edit.filter_condition
    if condition is not None and step[condition.name] != condition.value:
        useless = [p.name.replace("_", "-") for p in edit if p.panel == FILTER_PANEL and p.name in typed]
        notes += [f"--{name} {condition.note}" for name in useless]
    return notes
