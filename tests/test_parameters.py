"""Parameters of edits: declared once, within the ranges of the functions, and listed in the documentation."""

import ast
import inspect
import re
from typing import get_args

import pytest
from torch import Tensor

import nlfilter_torch
from benchmarks import parameters
from nlfilter_torch.photo.declared.declaration import Edit, Parameter
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from nlfilter_torch.photo.declared.shared_parameters import FILTER
from nlfilter_torch.photo.picture.source import Source
from tests.pages import ROOT

EVERY = [(edit, parameter) for edit in EDITS.values() for parameter in edit]


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


@pytest.mark.parametrize(("edit", "parameter"), EVERY, ids=lambda value: value.name)
def test_defaults_are_valid(edit: Edit, parameter: Parameter) -> None:
    assert parameter.is_valid(parameter.default)
    assert parameter.idle is ... or parameter.idle == 1.0 or parameter.is_valid(parameter.idle)
    if parameter.slider is not None and parameter.slider.none is None:
        assert parameter.low <= parameter.slider.low < parameter.slider.high <= parameter.high
    for value in (parameter.low, parameter.high) if parameter.domain not in (None, "choice", "count") else ():
        parameter.check_argument(parameter.argument_of(value, (400, 600)))


NAMES = [edit.function or edit.name for edit in (*EDITS.values(), MASK)]


@pytest.mark.parametrize("name", NAMES)
def test_docstrings_describe_the_arguments_of_the_function_of_an_image(name: str) -> None:
    function = getattr(nlfilter_torch, name)
    described = re.findall(r"^    (\**)(\w+): ", inspect.getdoc(function).split("Args:")[1], flags=re.MULTILINE)
    assert [argument for _, argument in described] == list(inspect.signature(function).parameters)
    assert list(function.__annotations__) == [argument for _, argument in described] + ["return"]
    of_image, *others = inspect.signature(function).parameters.values()
    of_source, *same = inspect.signature(function.fit).parameters.values()
    assert (of_image.annotation, of_source.annotation) == (Tensor, Source)
    assert others == same


@pytest.mark.parametrize("name", NAMES)
def test_the_image_is_the_first_argument_or_a_keyword(name: str) -> None:
    function, picture = getattr(nlfilter_torch, name), "grey" if name == "colorize" else "image"
    with pytest.raises(TypeError, match=rf"{picture} must be a torch.Tensor, got str"):
        function(**{picture: "photo.png"})
    with pytest.raises(TypeError, match=rf"{name}\(\) missing 1 required positional argument: '{picture}'"):
        function()
    with pytest.raises(TypeError, match=rf"{name}\(\) got multiple values for argument '{picture}'"):
        function(None, **{picture: None})


@pytest.mark.parametrize("edit", [*EDITS.values(), MASK], ids=lambda edit: edit.name)
def test_annotations_say_which_numbers_may_differ_between_images(edit: Edit) -> None:
    function = inspect.signature(getattr(nlfilter_torch, edit.function or edit.name)).parameters
    for parameter in edit:
        if parameter.kind == "number" and parameter.domain is not None:
            annotation = function[parameter.keyword].annotation
            assert parameter.per_image == (Tensor in get_args(annotation)), parameter.name


@pytest.mark.parametrize("edit", EDITS.values(), ids=lambda edit: edit.name)
def test_functions_have_the_declared_defaults(edit: Edit) -> None:
    function = inspect.signature(getattr(nlfilter_torch, edit.function or edit.name)).parameters
    for parameter in edit:
        name = parameter.keyword
        if name in function and parameter.kind != "sliders" and name != "photometric_bandwidth":
            is_idle = edit.name == "tone" and parameter.idle is not ...
            wanted = parameter.idle if is_idle else edit.defaults[name]
            assert function[name].default == wanted
        assert name in function or name in FILTER or parameter.name == "inside"
