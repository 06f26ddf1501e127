"""Options of a filter: signatures show them with the defaults that are declared once."""

import dataclasses
import inspect
from collections.abc import Callable

import pytest
import torch

import nlfilter_torch
from nlfilter_torch import nonlocal_operator
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.options import FilterOptions
from tests.problems import noise


def public_callables() -> dict[str, Callable[..., object]]:
    """Public functions and constructors, by name."""
    return {
        name: value.__init__ if isinstance(value := getattr(nlfilter_torch, name), type) else value
        for name in nlfilter_torch.__all__
        if callable(getattr(nlfilter_torch, name))
    }


@pytest.mark.parametrize("name", ["nonlocal_operator", "operator_from_features", "NonlocalAffinity", "NonlocalFilter"])
def test_signatures_show_every_option_with_its_declared_default(name: str) -> None:
    parameters = inspect.signature(public_callables()[name]).parameters
    of_guides = {"patch_size", "photometric_bandwidth", "spatial_bandwidth", "guide_channels", "patch_weights"}
    for field in dataclasses.fields(FilterOptions):
        if name != "operator_from_features" or field.name not in of_guides:
            assert parameters[field.name].default == field.default, field.name


def test_no_function_of_the_library_hides_arguments() -> None:
    for name, function in public_callables().items():
        if not function.__module__.startswith("nlfilter_torch.photo"):
            kinds = {parameter.kind for parameter in inspect.signature(function).parameters.values()}
            assert inspect.Parameter.VAR_KEYWORD not in kinds or "dataclass" in repr(function), name


def test_a_guide_whose_scale_was_checked_is_not_warned_of() -> None:
    guide = 255 * noise(1, 1, 8, 9)
    with pytest.warns(UserWarning, match="guide must be in or near"):
        expected = nonlocal_operator(guide, num_landmarks=20)
    operator = operator_from_guide(guide, FilterOptions(num_landmarks=20))
    torch.testing.assert_close(operator.factor, expected.factor, atol=0, rtol=0)
    with pytest.raises(ValueError, match="patch_size must be odd"):
        operator_from_guide(guide, FilterOptions(patch_size=4))
