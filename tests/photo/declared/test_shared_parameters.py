"""Declarations that several edits share."""

import pytest

from nlfilter_torch.photo.declared.declaration import Slider
from nlfilter_torch.photo.declared.shared_parameters import (
    COLOUR_TOLERANCE,
    FILTER_ARGUMENTS,
    LIMITS,
    LOOK,
    VIEWING_SIZE,
    choice,
    filter_parameters,
    gain,
    number,
    sliders,
)


def test_kinds_of_parameters() -> None:
    width = number("width", 2.0, "Width.", (1, 9), "px", slider=Slider("Width", 1, 5, 0.5))
    assert (width.kind, width.low, width.high, width.unit, width.slider) == (
        "number", 1, 9, "px", Slider("Width", 1, 5, 0.5),
    )  # fmt: skip
    strength = gain("strength", 1.0, "Strength.", idle=1.0)
    assert strength.is_valid(-1e6)
    assert strength.per_image
    assert sliders("alpha", (1.0, 1.0), "Sliders.").is_valid([2.0, 1e6])
    aperture = choice("aperture", ("disc", "gaussian"), "Aperture.")
    assert aperture.default == "disc"
    assert not aperture.is_valid("square")


def test_the_filter_of_an_edit() -> None:
    parameters = {parameter.keyword: parameter for parameter in filter_parameters(bandwidth=30.0, share=0.25)}
    assert tuple(parameters) == FILTER_ARGUMENTS
    assert parameters["spatial_bandwidth"].distance(None, (40, 60)) == 10.0
    assert "Default: 0.25 of the short side." in parameters["spatial_bandwidth"].help
    assert not parameters["photometric_bandwidth"].is_valid("auto")
    assert not parameters["photometric_bandwidth"].is_valid(None)
    assert not parameters["spatial_bandwidth"].is_valid("none")
    assert not parameters["patch_size"].is_valid(4)


def test_a_filter_may_estimate_its_bandwidth_and_ignore_distance() -> None:
    parameters = {parameter.name: parameter for parameter in filter_parameters(auto=True, far=True)}
    assert parameters["bandwidth"].is_valid("auto")
    assert parameters["bandwidth"].is_valid(None)  # no default of its own
    assert parameters["spatial_bandwidth"].is_valid("none")
    assert "Default: no limit. `none`: distance is ignored" in parameters["spatial_bandwidth"].help


def test_units_of_selections_and_views() -> None:
    assert COLOUR_TOLERANCE.argument_of(8.0, (40, 60)) == 0.08
    assert COLOUR_TOLERANCE.keyword == "photometric_bandwidth"
    assert VIEWING_SIZE.default_number == 1.5
    assert LIMITS.choices == ("soft", "none")
    with pytest.raises(ValueError, match=r"viewing_size must be at least 0.*pass 0 for the size of the image"):
        VIEWING_SIZE.check_argument(-1.0)


def test_the_default_look_changes_nothing() -> None:
    parts = [parameter for parameter in LOOK if parameter.kind == "sliders"]
    names = ["alpha", "bands", "texture", "red", "green", "blue", "matrix", "saturation", "stretch", "local"]
    assert [part.name for part in parts] == names
    assert all(part.is_idle(part.default) for part in parts)
    assert LOOK["red"].default == tuple(i / 16 for i in range(17))
