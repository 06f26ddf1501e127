"""Declarations: valid values, conversion to arguments of functions, checks, and scribbles."""

import re

import pytest
import torch

from nlfilter_torch.photo.declared.declaration import Edit, Parameter, Scribble

NUMBER = Parameter("contrast", "number", 1.2, "", -5.0, 5.0, "gain", "finite", idle=1.0)
WIDTH = Parameter("patch_size", "odd", 5, "", 1, 99, "px")
LEVEL = Parameter("bandwidth", "number", None, "", 0.01, 1e6, "levels", optional=True, words=("auto",), argument="h")
LENGTH = Parameter("radius", "number", 2.5, "", 0.1, 20, "%", "positive", min_pixels=0.3)
DISTANCE = Parameter("spatial_bandwidth", "number", None, "", 0.01, 1e6, "px", optional=True, share=0.25)
COUNT = Parameter("tones", "count", None, "", 2, 64, domain="count", optional=True, idle=None)
CHOICE = Parameter("limits", "choice", "soft", "", domain="choice", choices=("soft", "none"))
SLIDERS = Parameter("alpha", "sliders", (2.0, 1.0), "", -1e6, 1e6, "gain", idle=1.0)
EDIT = Edit(
    "example",
    "",
    (NUMBER, LEVEL, LENGTH),
    scribbles=(
        Scribble("strokes", "Paint", "colours", needed=True),
        Scribble("keep", "Keep", role="background", option="--keep"),
    ),
)


VALUES = [
    (NUMBER, (-5, 0.0, 5.0), (5.1, True, None, "1", float("nan"), [1.0])),
    (WIDTH, (1, 99), (2, 3.0, 101, None)),
    (LEVEL, (0.01, 7, "auto", None), (0.0, "all")),
    (COUNT, (2, 64, None), (1, 2.5, 65)),
    (CHOICE, ("soft", "none"), ("hard", None, 1)),
    (SLIDERS, ((1.0, 2.0), [0, 3, -1]), ((1.0,), [1.0, "2"], 1.0, [0.0] * 101, [1e7, 1.0])),
]


def test_values_of_files_are_valid_or_not() -> None:
    for parameter, valid, invalid in VALUES:
        assert [value for value in valid if not parameter.is_valid(value)] == []
        assert [value for value in invalid if parameter.is_valid(value)] == []


def test_a_list_of_fixed_length_has_that_length() -> None:
    matrix = Parameter("matrix", "sliders", (0.0,) * 9, "", length=9)
    assert matrix.is_valid([0.5] * 9)
    assert not matrix.is_valid([0.5] * 8)
    assert matrix.wanted.startswith("a list of 9 numbers")


WANTED = [
    (NUMBER, "a number from -5 to 5"),
    (WIDTH, "an odd number from 1 to 99"),
    (LEVEL, 'a positive number of grey levels, from 0.01 to 1000000, or "auto", or null'),
    (CHOICE, '"soft" or "none"'),
    (SLIDERS, "a list of 2 to 100 numbers from -1000000 to 1000000"),
]


def test_errors_say_which_values_are_valid() -> None:
    for parameter, sentence in WANTED:
        assert parameter.wanted == sentence


def test_idle_values_are_those_that_change_nothing() -> None:
    assert NUMBER.is_idle(1.0)
    assert not NUMBER.is_idle(1.2)
    assert SLIDERS.is_idle((1.0, 1.0, 1.0))
    assert not SLIDERS.is_idle((1.0, 1.1))
    assert COUNT.is_idle(None)
    assert not CHOICE.is_idle("soft")  # no value of it changes nothing by itself
    curve = Parameter("red", "sliders", (0.0, 1.0), "", idle=(0.0, 1.0))
    assert curve.is_idle((0.0, 1.0))
    assert not curve.is_idle((0.0, 0.5))
    assert (NUMBER.default_number, NUMBER.idle_number) == (1.2, 1.0)


def test_values_become_arguments_in_the_units_of_the_function() -> None:
    size = (400, 600)
    assert LEVEL.argument_of(51.0, size) == 0.2
    assert Parameter("tolerance", "number", 8.0, "", unit="lab").argument_of(8.0, size) == 0.08
    assert LENGTH.argument_of(2.5, size) == 10.0
    assert LENGTH.argument_of(0.01, size) == 0.3  # the least number of pixels
    assert DISTANCE.argument_of(30.0, size, stride=2) == 15.0
    assert WIDTH.argument_of(5, size, stride=2) == 5  # counted in pixels of any picture
    assert SLIDERS.argument_of((2.0, 1.0), size) == (2.0, 1.0)
    assert LEVEL.argument_of("auto", size) == "auto"
    assert LEVEL.argument_of(None, size) is None


def test_lengths_and_distances_depend_on_the_short_side() -> None:
    size = (400, 600)
    assert LENGTH.pixels(None, size) == 10.0
    assert LENGTH.pixels(7, size) == 7.0
    assert DISTANCE.distance(None, size) == 100.0
    assert DISTANCE.distance(12.0, size) == 12.0
    far = Parameter("spatial_bandwidth", "number", None, "", unit="px", words=("none",), share=0.25)
    assert far.distance("none", size) is None
    with pytest.raises(ValueError, match="spatial_bandwidth must be one of 'none', got 'far'"):
        far.distance("far", size)
    assert Parameter("spatial_bandwidth", "number", None, "", unit="px").distance(None, size) is None


def test_arguments_are_checked_under_the_name_of_the_function() -> None:
    LENGTH.check_argument(None)
    LENGTH.check_argument(3.0)
    COUNT.check_argument(None)
    for parameter, value, kind, sentence in (
        (LENGTH, -1.0, ValueError, "radius must be positive"),
        (LENGTH, torch.tensor(1.0), TypeError, "radius must be a number, got Tensor; pass a float or None"),
        (NUMBER, float("inf"), ValueError, "contrast must be finite"),
        (COUNT, 65, ValueError, "tones must be at most 64, got 65"),
        (CHOICE, "hard", ValueError, "limits must be one of 'soft', 'none', got 'hard'"),
    ):
        with pytest.raises(kind, match=re.escape(sentence)):
            parameter.check_argument(value)


def test_numbers_for_each_image_are_tensors_of_their_count() -> None:
    amount = Parameter("amount", "number", 4.0, "", unit="gain", domain="finite", per_image=True)
    amount.check_argument(torch.ones(2), batch=2)
    with pytest.raises(ValueError, match="amount must"):
        amount.check_argument(torch.ones(3), batch=2)
    with pytest.raises(TypeError, match="contrast must be a number, got Tensor"):
        NUMBER.check_argument(torch.ones(2), batch=2)


def test_an_edit_knows_its_parameters_by_name_and_by_argument() -> None:
    assert EDIT["bandwidth"] is EDIT["h"] is LEVEL
    assert [parameter.name for parameter in EDIT] == ["contrast", "bandwidth", "radius"]
    assert EDIT.defaults == {"contrast": 1.2, "h": None, "radius": None}  # the radius depends on the size
    with pytest.raises(ValueError, match="radius must be positive"):
        EDIT.check(contrast=1.0, radius=0.0)


def test_an_edit_tells_its_scribbles() -> None:
    assert EDIT.words == ("colour", "out")
    assert EDIT.requires_strokes
    assert [option.scribble.argument for option in EDIT.with_options] == ["keep"]
    assert [scribble.argument for scribble in EDIT.with_role("background", "added")] == ["keep"]
    assert EDIT.regional is None
    regions = Scribble("regions", "Edit this", "sliders")
    regional = Edit("detail", "", (SLIDERS,), scribbles=(regions,))
    assert regional.regional is regions
    assert not regional.requires_strokes
