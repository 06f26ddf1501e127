"""Parameters of edits: declared once, within the ranges of the functions, and listed in the documentation."""

import ast
import inspect

import pytest

import nlfilter_torch
from benchmarks import parameters
from nlfilter_torch.edits.applying import FITS
from nlfilter_torch.edits.declaration import Edit, Parameter
from nlfilter_torch.edits.parameters import EDITS
from nlfilter_torch.edits.shared_parameters import FILTER
from tests.pages import ROOT

EVERY = [(edit, parameter) for edit in EDITS.values() for parameter in edit]


def test_the_page_is_up_to_date() -> None:
    assert (ROOT / "docs" / "parameters.md").read_text() == parameters.page()


def test_each_is_declared_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert parameters.main([]) == 0
    assert "recolor reach: 1 (edits/parameters.py:" in capsys.readouterr().out


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


@pytest.mark.parametrize("edit", EDITS.values(), ids=lambda edit: edit.name)
def test_functions_have_the_declared_defaults(edit: Edit) -> None:
    public = {"detail": "enhance", "tone": "adjust_tone", "look": "apply_look"}.get(edit.name, edit.name)
    function = inspect.signature(getattr(nlfilter_torch, public)).parameters
    for parameter in edit:
        name = parameter.keyword
        if name in function and parameter.kind != "sliders" and name != "photometric_bandwidth":
            is_idle = edit.name == "tone" and parameter.idle is not ...
            wanted = parameter.idle if is_idle else edit.defaults[name]
            assert function[name].default == wanted
        assert name in function or name in FILTER or parameter.name == "inside"
    fit = inspect.signature(FITS[edit.name]).parameters
    for name, argument in fit.items():
        if argument.default is not argument.empty:
            assert function[name].default == argument.default
