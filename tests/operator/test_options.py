"""Options of a filter: signatures show the defaults that are declared once, and numbers of landmarks are reduced."""

import dataclasses
import inspect
from collections.abc import Callable

import pytest
import torch

import nlfilter_torch
from nlfilter_torch import nonlocal_operator, operator_from_features
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.landmarks import assign_landmarks, landmarks_of
from nlfilter_torch.operator.options import Assignment, FilterOptions
from tests.problems import build, noise, seeded


def public_callables() -> dict[str, Callable[..., object]]:
    """Public functions and constructors, by name."""
    return {
        name: value.__init__ if isinstance(value := getattr(nlfilter_torch, name), type) else value
        for name in nlfilter_torch.__all__
        if callable(getattr(nlfilter_torch, name))
    }


LAYERS = "NonlocalAffinity", "NonlocalFilter"


@pytest.mark.parametrize("name", ["nonlocal_operator", "operator_from_features", *LAYERS])
def test_signatures_show_every_option_with_its_declared_default(name: str) -> None:
    parameters = inspect.signature(public_callables()[name]).parameters
    of_guides = {"patch_size", "photometric_bandwidth", "spatial_bandwidth", "guide_channels", "patch_weights"}
    for field in dataclasses.fields(FilterOptions):
        if field.name == "covering":  # a word for num_landmarks
            continue
        # None lets a layer tell a guide that is passed to it from an image that is its own guide.
        default = None if name in LAYERS and field.name == "guide_channels" else field.default
        if name != "operator_from_features" or field.name not in of_guides:
            assert parameters[field.name].default == default, field.name


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


def test_an_assignment_serves_images_of_as_many_points() -> None:
    shared = Assignment(torch.arange(5)[None], None, None, 60)
    assert (shared.batch, shared.num_landmarks) == (1, 5)
    assert shared.serves(3, 60)
    assert not shared.serves(3, 61)
    assert shared.on(torch.device("cpu")) is shared


def test_landmarks_by_an_assignment_are_those_it_was_returned_with() -> None:
    features = noise(2, 3, 200)
    landmarks, assignment = assign_landmarks(features, (10, 20), FilterOptions(num_landmarks=7))
    assert (assignment.batch, assignment.num_landmarks) == (2, 7)
    assert not assignment.serves(3, 200)
    assert torch.equal(landmarks_of(features, assignment), landmarks)


def test_more_landmarks_than_pixels_are_reduced_with_a_warning() -> None:
    guide = noise(1, 1, 4, 5)
    with pytest.warns(UserWarning, match="num_landmarks must be at most the number of pixels, 20, got 100"):
        operator = nonlocal_operator(guide)
    torch.testing.assert_close(operator.to_dense(), build(guide, num_landmarks=20).to_dense())


def test_more_landmarks_than_points_are_reduced() -> None:
    with pytest.warns(UserWarning, match="num_landmarks must be at most the number of pixels, 12, got 100"):
        operator = operator_from_features(noise(1, 3, 12), size=(3, 4), generator=seeded())
    assert operator.factor.shape == (1, 12, 12)
