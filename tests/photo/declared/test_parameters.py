"""Parameters of edits: declared once, within the ranges of the functions, and listed in the documentation."""

import ast
import inspect
import re
from dataclasses import fields
from typing import get_args

import pytest
from torch import Tensor

from docs import parameters
from nlfilter_torch import photo
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from nlfilter_torch.photo.declared.shared_parameters import FILTER_ARGUMENTS
from nlfilter_torch.photo.edits.applying import EDIT_OF
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.selections.mask import RegionMask
from tests.pages import ROOT


def test_the_page_is_up_to_date() -> None:
    assert (ROOT / "docs" / "parameters.md").read_text() == parameters.page()


def test_each_is_declared_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert parameters.main([]) == 0
    assert "recolor reach: 1 (photo/declared/parameters.py:" in capsys.readouterr().out


def test_another_default_counts_as_a_declaration() -> None:
    tree = ast.parse(
        "def f(a, reach=0.7, *, alpha='1,2', keep=None): ...\nclass C:\n    time: float = 2.0\n    x: int = Y"
    )
    assert sorted(name for _, name in parameters.literals(tree)) == ["alpha", "reach", "time"]


@pytest.mark.parametrize("edit", EDITS.values(), ids=lambda edit: edit.name)
def test_defaults_are_valid(edit: Edit) -> None:
    for parameter in edit:
        assert parameter.is_valid(parameter.default), parameter.name
        assert parameter.idle is ... or parameter.idle == 1.0 or parameter.is_valid(parameter.idle), parameter.name
        if parameter.slider is not None and parameter.slider.none is None:
            assert parameter.low <= parameter.slider.low < parameter.slider.high <= parameter.high, parameter.name
        for value in (parameter.low, parameter.high) if parameter.domain not in (None, "choice", "count") else ():
            parameter.check_argument(parameter.argument_of(value, (400, 600)))


NAMES = [edit.function or edit.name for edit in (*EDITS.values(), MASK)]


def test_docstrings_describe_the_arguments_of_the_function_of_an_image() -> None:
    for name in NAMES:
        function = getattr(photo, name)
        described = re.findall(r"^    (\**)(\w+): ", inspect.getdoc(function).split("Args:")[1], flags=re.MULTILINE)
        assert [argument for _, argument in described] == list(inspect.signature(function).parameters)
        assert list(function.__annotations__) == [argument for _, argument in described] + ["return"]
        assert next(iter(inspect.signature(function).parameters.values())).annotation is Tensor


@pytest.mark.parametrize("edit", [*EDIT_OF.values(), RegionMask], ids=lambda edit: edit.declared.name)
def test_settings_of_an_edit_are_arguments_of_its_function(edit: type[PhotoEdit]) -> None:
    function = inspect.signature(getattr(photo, edit.declared.function or edit.declared.name)).parameters
    drawn = {"image", "grey", "strokes", *(scribble.argument for scribble in edit.declared.scribbles)}
    measured = {"options", "names", "working", "hot_pixels"}
    settings = {field.name for field in fields(edit)} - measured - {"grey"}  # which colorize sets for its own masks
    options = {field.name for field in fields(FilterOptions)} & set(function)
    assert settings | options == set(function) - drawn
    assert {parameter.keyword for parameter in edit.declared if parameter.is_option} <= settings | options
    for name in options - {parameter.keyword for parameter in edit.declared}:
        assert function[name].default == vars(edit.filtering)[name], name


@pytest.mark.parametrize("edit", [*EDIT_OF.values(), RegionMask], ids=lambda edit: edit.declared.name)
def test_every_argument_of_a_function_reaches_its_edit(edit: type[PhotoEdit], monkeypatch: pytest.MonkeyPatch) -> None:
    reached: dict[str, object] = {}

    def received(made: PhotoEdit, image: object, drawn: Drawn[object], **_: object) -> None:
        reached.update(vars(made) | vars(made.options) | {"image": image, "grey": image, "strokes": drawn.colours})
        reached["box"] = drawn.box
        reached.update(drawn.masks)

    monkeypatch.setattr("nlfilter_torch.photo.picture.in_memory.edit_image", received)
    monkeypatch.setattr("nlfilter_torch.photo.edits.recolor.check_image", lambda *_, **__: None)
    function = getattr(photo, edit.declared.function or edit.declared.name)
    arguments = {name: object() for name in inspect.signature(function).parameters}
    function(**arguments)
    assert {name: reached[name] for name in arguments} == arguments


def test_the_image_is_the_first_argument_or_a_keyword() -> None:
    for name in NAMES:
        function, picture = getattr(photo, name), "grey" if name == "colorize" else "image"
        parameters = inspect.signature(function).parameters.values()
        others = {p.name: None for p in parameters if p.default is inspect.Parameter.empty and p.name != picture}
        with pytest.raises(TypeError, match=rf"{picture} must be a torch.Tensor, got str"):
            function(**{picture: "photo.png"}, **others)
        with pytest.raises(TypeError, match=rf"{name}\(\) missing 1 required positional argument: '{picture}'"):
            function(**others)
        with pytest.raises(TypeError, match=rf"{name}\(\) got multiple values for argument '{picture}'"):
            function(None, **{picture: None}, **others)


def test_annotations_say_which_numbers_may_differ_between_images() -> None:
    for edit in [*EDITS.values(), MASK]:
        function = inspect.signature(getattr(photo, edit.function or edit.name)).parameters
        for parameter in edit:
            if parameter.kind == "number" and parameter.domain is not None:
                annotation = function[parameter.keyword].annotation
                assert parameter.per_image == (Tensor in get_args(annotation)), parameter.name


def test_functions_have_the_declared_defaults() -> None:
    for edit in EDITS.values():
        function = inspect.signature(getattr(photo, edit.function or edit.name)).parameters
        for parameter in edit:
            name = parameter.keyword
            if name in function and parameter.kind != "sliders" and name != "photometric_bandwidth":
                is_idle = edit.name == "tone" and parameter.idle is not ...
                wanted = parameter.idle if is_idle else edit.defaults[name]
                assert function[name].default == wanted
            assert name in function or name in FILTER_ARGUMENTS or parameter.name == "inside"
