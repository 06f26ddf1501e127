"""Developing as a value: where the picture lies, strokes there and back, files, and bad values."""

import json
import math
import random
from contextlib import suppress
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch.photo.declared.development import DEVELOP, WHOLE_CROP, Crop, Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke

SHARES = st.floats(0, 1)
SIZES = st.tuples(st.integers(1, 300), st.integers(1, 300))


def edges(values: list[float]) -> Crop:
    """A crop with corners at two points."""
    left, right = sorted(values[:2])
    top, bottom = sorted(values[2:])
    return left, top, max(right, left + 1e-3), max(bottom, top + 1e-3)


CROPS = st.lists(st.floats(0, 0.99), min_size=4, max_size=4).map(edges)


@given(SIZES, CROPS, st.floats(-45, 45), SHARES, SHARES)
def test_points_there_and_back(size: tuple[int, int], crop: Crop, degrees: float, x: float, y: float) -> None:
    try:
        frame = Development(straighten=degrees, crop=crop).frame(size)
    except ValueError:  # the middle of the crop is outside
        return
    assert frame.outward(*frame.inward(x, y)) == pytest.approx((x, y), abs=1e-9)
    stroke = Stroke(((x, y),), 0.1, "in")
    back = frame.mark_outward(frame.mark_inward(stroke))
    assert back.points[0] == pytest.approx((x, y), abs=1e-9)
    assert back.radius == pytest.approx(0.1)


@given(st.tuples(st.integers(8, 300), st.integers(8, 300)), CROPS, st.floats(-45, 45))
def test_no_corner_is_empty(size: tuple[int, int], crop: Crop, degrees: float) -> None:
    try:
        frame = Development(straighten=degrees, crop=crop).frame(size)
    except ValueError:
        return
    assert 0 <= frame.top <= frame.top + frame.height <= size[0]
    assert 0 <= frame.left <= frame.left + frame.width <= size[1]
    if min(frame.size) > 1:  # a single pixel may stand for less
        for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
            assert all(-1e-6 < share < 1 + 1e-6 for share in frame.outward(*corner))


def test_straightening_keeps_the_proportions_and_as_much_as_possible() -> None:
    frame = Development(straighten=5.0).frame((2000, 3000))
    assert frame.width / frame.height == pytest.approx(1.5, abs=0.002)
    share = 2000 / (2000 * math.cos(math.radians(5)) + 3000 * math.sin(math.radians(5)))
    assert frame.height == pytest.approx(2000 * share, abs=2)
    assert Development(straighten=90 / 4).frame((50, 50)).size == Development(straighten=-90 / 4).frame((50, 50)).size


def test_clockwise_is_positive() -> None:
    """What is on the right moves down."""
    frame = Development(straighten=10.0).frame((100, 100))
    assert frame.inward(0.9, 0.5)[1] > 0.5 > frame.inward(0.1, 0.5)[1]


def test_a_crop_alone_is_of_whole_pixels() -> None:
    frame = Development(crop=(0.1, 0.0, 1.0, 0.9)).frame((10, 20))
    assert (frame.top, frame.left, frame.size, frame.angle) == (0, 2, (9, 18), 0)
    assert Development(crop=(0.999, 0.0, 1.0, 0.001)).frame((3, 4)).size == (1, 1)
    assert Development(exposure=1.0).frame((3, 4)).is_whole


@pytest.mark.parametrize("seed", range(3))
def test_the_edges_of_a_frame_give_it_again(seed: int) -> None:
    """Also of a crop that is thinner than a pixel, whose frame is within the turned picture."""
    draw = random.Random(seed)
    frames = []
    while len(frames) < 500:
        size = draw.randint(1, 300), draw.randint(1, 300)
        left, top = draw.random(), draw.random()
        thin = draw.choice([1e-6, 1.0]), draw.choice([1e-6, 1.0])
        crop = left, top, left + thin[0] * (1 - left), top + thin[1] * (1 - top)
        development = Development(straighten=draw.choice([0.0, draw.uniform(-45, 45)]), crop=crop)
        with suppress(ValueError):  # its middle is outside
            frame = development.frame(size)
            frames.append(frame)
            assert replace(development, crop=frame.edges).frame(size) == frame
            x, y = frame.outward(0.5, 0.5)
            assert 0 < x < 1
            assert 0 < y < 1


def test_edges_may_be_a_list() -> None:
    entries = [0, 0, 1, 1]
    development = Development(crop=entries)  # type: ignore[arg-type]
    assert development.is_idle
    assert hash(development) == hash(Development())


def test_a_crop_whose_middle_is_outside_is_refused() -> None:
    with pytest.raises(ValueError, match="crop must have its middle within the photograph turned by 45 degrees"):
        Development(straighten=45.0, crop=(0.0, 0.0, 0.1, 0.1)).frame((100, 100))


def test_strokes_of_steps_are_mapped() -> None:
    stroke = Stroke(((0.75, 0.5), (0.5, 0.25)), 0.02, "in")
    recipe = Recipe((Step("detail", (stroke,)), Step("tone")), Development(exposure=1.0, crop=(0.5, 0.0, 1.0, 1.0)))
    mapped = recipe.on_developed((100, 200))
    assert mapped.develop.is_idle
    assert mapped.steps[0].strokes[0].points == ((0.5, 0.5), (0.0, 0.25))
    assert mapped.steps[0].strokes[0].radius == pytest.approx(0.02)  # the short side is the height before and after
    assert mapped.steps[1] == Step("tone")
    assert recipe.replaced(0).develop == recipe.with_current(Step("sharpen")).drawn.develop == recipe.develop
    assert recipe.moved(0, 1).effect != recipe.effect


def test_steps_whose_strokes_are_cropped_away_change_nothing() -> None:
    corner, out = Stroke(((0.1, 0.1),), 0.02, "in"), Stroke(((0.9, 0.9),), 0.02, "out")
    recolor = Step("recolor", (replace(corner, paint="#2040e0"), replace(out, paint="out")))
    region = Step("detail", (corner,), alpha=(2.0, 1.0), inside=(4.0, 1.0))
    recipe = Recipe((recolor, region, Step("tone")), Development(crop=(0.5, 0.5, 1.0, 1.0)))
    mapped = recipe.on_developed((100, 200)).steps
    assert [step.changes() for step in mapped] == [False, True, True]
    assert not mapped[1].has_region()
    assert recipe.cropped_away((100, 200)) == [(1, recolor), (2, region)]
    assert replace(recipe, develop=Development(exposure=1.0)).cropped_away((100, 200)) == []
    astray = Recipe((Step("detail", (replace(corner, points=((-1.0, 0.1),)),), inside=(4.0, 1.0)),), recipe.develop)
    assert astray.on_developed((100, 200)).steps[0].has_region()  # which is refused where it is painted


def test_there_and_back_through_a_file() -> None:
    recipe = Recipe(
        (Step("tone"),), Development(exposure=0.5, warmth=0.1, tint=-0.2, straighten=1.5, crop=(0.1, 0.0, 1.0, 0.9))
    )
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe
    only = Recipe((), Development(exposure=1.0))
    assert json.loads(only.to_json()) == {"version": 1, "develop": {"exposure": 1.0}, "steps": []}
    assert only.changes
    assert list(json.loads(only.to_json(complete=True))["develop"]) == [parameter.name for parameter in DEVELOP]
    assert "develop" not in Recipe((Step("tone"),)).to_json()


BAD_ENTRIES = [
    ("[]", r"develop in edit.json must be an object, got \[\]; correct it"),
    ('{"gain": 1}', "develop in edit.json must have no entries other than exposure, .*, got gain; remove it"),
    ('{"exposure": 9}', "exposure of develop in edit.json must be a number from -5 to 5, got 9; correct it"),
    ('{"exposure": NaN}', "exposure of develop in edit.json must be a number from -5 to 5, got NaN; correct it"),
    ('{"tint": true}', "tint of develop in edit.json must be a number from -1 to 1, got true; correct it"),
    ('{"straighten": "5"}', 'straighten of develop in edit.json must be a number from -45 to 45, got "5"'),
    ('{"crop": [0, 0, 1]}', r"crop of develop in edit.json must be .* shares from 0 to 1, .*, got \[0, 0, 1\];"),
    ('{"crop": [0.5, 0, 0.5, 1]}', "left below right and top below bottom, got"),
    ('{"crop": null}', "crop of develop in edit.json must be .*, got null; correct it"),
]


def test_bad_entries() -> None:
    for entry, sentence in BAD_ENTRIES:
        with pytest.raises(ValueError, match=sentence):
            Recipe.from_json(f'{{"version": 1, "develop": {entry}, "steps": []}}', "edit.json")


def test_bad_values_in_python() -> None:
    with pytest.raises(ValueError, match="warmth must be a number from -1 to 1, got 3; correct it"):
        Development(warmth=3)
    with pytest.raises(
        ValueError, match=r'temperature must be a number from 2000 to 15000, or "auto", or null, got 0\.5'
    ):
        Development(temperature=0.5)
    with pytest.raises(ValueError, match="rotate must be 0, 90, 180 or 270 degrees, got 45; see straighten for others"):
        Development(rotate=45)
    with pytest.raises(ValueError, match="curve must be a list of 2 to 100 numbers from 0 to 1, got"):
        Development(curve=(0.0, 1.5))
    assert Development(crop=WHOLE_CROP).is_idle
