"""The editor's preview: it shows what is saved, and does not recompute what has not changed."""

import gc
from functools import partial

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch import estimate_bandwidth, nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.app.preview import PIXELS, Preview, ignored, operator_of_sample, reduce, selected
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Region, Stroke
from nlfilter_torch.photo.edits.applying import PreparedStep, apply_step
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.source import seeded
from nlfilter_torch.photo.picture.viewing import viewed_size
from tests.problems import cat, difference
from tests.strokes import mask_of

FEW = {"landmarks": 60}


def test_preview_of_a_small_photograph_is_the_photograph(session: Session) -> None:
    assert session.preview.stride == 1
    assert torch.equal(session.preview.pixels, cat())


@pytest.mark.parametrize("colour", [True, False])
def test_what_is_shown_is_what_is_saved(colour: bool) -> None:
    image = cat() if colour else reduce_channels(cat(), "luminance")
    region = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")
    outside = Stroke(((0.8, 0.8),), 0.04, "out")
    preview = Preview(image)
    for recipe in (
        Recipe(),
        Recipe((Step("detail", alpha=(3.0, 2.0, 1.0), **FEW),)),
        Recipe((Step("detail", bandwidth=15.0, spatial_bandwidth=20.0, patch_size=3, landmarks=40),)),
        Recipe((Step("detail", (region, outside), alpha=(0.2, 1.0, 1.0), inside=(3.0, 4.0, 1.0), **FEW),)),
        Recipe((Step("detail", alpha=(2.0, 1.0, 1.0, 1.0), **FEW), Step("defocus", (region,)))),
        Recipe((Step("denoise"), Step("detail", residual=1.0, **FEW), Step("tone", **FEW), Step("sharpen", **FEW))),
    ):
        assert difference(preview.render(recipe), apply_recipe(recipe, image)) < 1


def counted(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Record events of steps: ``filter`` for each filter that is built, ``edit`` for each picture that is drawn."""
    events: dict[str, list[str]] = {edit: [] for edit in EDITS}

    class Spied(PreparedStep):
        begun = False

        def __call__(self, step: Step) -> torch.Tensor:
            events[step.edit] += ["edit"] if self.begun else ["filter", "edit"]
            self.begun = True
            return super().__call__(step)

    monkeypatch.setattr("nlfilter_torch.photo.app.preview.PreparedStep", Spied)
    return events


def test_pictures_are_held_until_a_step_before_them_changes(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    events = counted(monkeypatch)["abstract"]
    session.set("abstract", power=0.1)
    first = session.render()
    assert torch.equal(session.render(), first)
    assert events == ["filter", "edit"]
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    assert not torch.equal(session.render(), first)
    assert events == ["filter", "edit"] * 2


HERE, THERE, BELOW = ((0.2, 0.2), (0.3, 0.2)), ((0.7, 0.6), (0.8, 0.7)), ((0.3, 0.8), (0.4, 0.85))
BLUE_AND_RED = (Stroke(HERE, 0.04, "#2040e0"), Stroke(THERE, 0.04, "#c02010"))
PAIRS = {
    "recolor": (
        Step("recolor", (Stroke(HERE, 0.04, "#2040e0"),)),
        Step("recolor", (Stroke(HERE, 0.04, "#20e040"), Stroke(THERE, 0.04, "out")), reach=0.5),
    ),
    "colorize": (
        Step("colorize", BLUE_AND_RED),
        Step("colorize", (*BLUE_AND_RED, Stroke(BELOW, 0.04, "#20a010")), strength=0.3),
    ),
    "defocus": (
        Step("defocus", (Stroke(HERE, 0.04, "in"),)),
        Step("defocus", (Stroke(THERE, 0.04, "in"),), radius=4.0),
    ),
    "abstract": (Step("abstract"), Step("abstract", power=0.05, edges=1.0, edge_width=0.4, tones=5)),
}


LATER = (Step("tone", contrast=1.4, **FEW), PAIRS["colorize"][0], PAIRS["recolor"][0])


def test_later_steps_stay_while_a_slider_moves(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are exact where the slider began, nearer to the complete picture than without them, and are not fitted."""
    first = Step("detail", alpha=(2.0, 1.0, 1.0, 1.0), **FEW)
    session.load(Recipe((first, *LATER)))
    complete = session.render()
    events = counted(monkeypatch)
    assert difference(session.render(0), complete) < 0.1
    session.set("detail", alpha=(1.2, 1.0, 1.0, 1.0), **FEW)
    moving = session.render(0)
    assert events == {edit: [] for edit in EDITS}
    wanted = Preview(cat()).render(session.recipe)
    assert rms(moving, wanted) < 0.5 * rms(Preview(cat()).render(Recipe(session.recipe.steps[:1])), wanted)
    assert difference(session.render(), wanted) < 0.1


def operators() -> set[int]:
    """Addresses of the operators in memory."""
    gc.collect()
    return {id(held) for held in gc.get_objects() if type(held) is NonlocalOperator}


def test_pictures_of_steps_hold_no_filters(session: Session) -> None:
    """Filters need a hundred times the memory of a picture, so only that of the step at work is held."""
    others = operators()
    for name in ("recolor", "colorize", "defocus"):
        session.load(Recipe((PAIRS[name][0],)))
        session.render()
        assert session.preview._filter is not None
        session.preview._filter = None
        assert operators() <= others


def test_a_step_that_begins_to_move_leaves_later_ones(session: Session) -> None:
    session.load(Recipe((Step("detail", alpha=(2.0, 1.0, 1.0, 1.0), **FEW), PAIRS["recolor"][0])))
    complete = session.render()
    session.set("denoise", strength=0.005)
    assert difference(session.render(0), complete) < 1


def test_opacity_needs_no_other_picture(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    session.load(Recipe((Step("detail", alpha=(3.0, 1.0, 1.0, 1.0), **FEW), Step("tone", **FEW))))
    session.render()
    session.load(session.recipe.replaced(1, session.recipe.steps[1].mixed(opacity=0.4)))
    wanted = apply_recipe(session.recipe, cat())
    events = counted(monkeypatch)["tone"]
    assert difference(session.render(), wanted) < 1
    session.load(session.recipe.replaced(1, session.recipe.steps[1].mixed(on=False)))
    assert difference(session.render(), apply_recipe(Recipe(session.recipe.steps[:1]), cat())) < 1
    assert events == []


@pytest.mark.parametrize("name", PAIRS)
def test_more_strokes_need_no_other_filter(name: str, session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = PAIRS[name]
    wanted = apply_step(second, session.preview.pixels).clamp(0, 1)
    session.load(Recipe((first,)))
    session.render()
    monkeypatch.setattr("nlfilter_torch.photo.picture.in_memory.operator_from_guide", None)
    session.load(Recipe((second,)))
    assert torch.equal(session.render(), wanted)


def test_another_radius_needs_no_other_mask(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    first = PAIRS["defocus"][0]
    wanted = apply_step(first.changed(radius=4.0), session.preview.pixels).clamp(0, 1)
    session.load(Recipe((first,)))
    session.render()
    for function in ("mask.fit_borders", "rough_mask.object_masks"):
        monkeypatch.setattr(f"nlfilter_torch.photo.selections.{function}", lambda *_: pytest.fail("computed again"))
    session.set("defocus", radius=4.0)
    assert torch.equal(session.render(), wanted)


def test_other_sliders_need_no_other_layers(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    for step, change in ((Step("tone", contrast=1.2), {"contrast": 1.1}), (Step("abstract"), {"power": 0.05})):
        wanted = apply_step(step.changed(**change), session.preview.pixels).clamp(0, 1)
        session.load(Recipe((step,)))
        session.render()
        with monkeypatch.context() as patch:
            patch.setattr("nlfilter_torch.photo.picture.in_memory.detail_layers", None)
            patch.setattr("nlfilter_torch.operator.spectrum.Spectrum.coefficients", None)
            session.set(step.edit, **change)
            assert torch.equal(session.render(), wanted)


def test_slow_edits_are_computed_at_knots_only(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    image = session.preview.pixels
    exact = {strength: apply_step(Step("denoise", strength=strength), image) for strength in (0.5, 1.0, 2.0, 3.0)}
    exact[0.0] = image
    between = {0.7: (0.5, 1.0, 0.4), 1.25: (1.0, 2.0, 0.25), 0.1: (0.0, 0.5, 0.2)}
    expected = exact | {at: torch.lerp(exact[low], exact[high], share) for at, (low, high, share) in between.items()}
    events = counted(monkeypatch)["denoise"]
    for strength in (0.5, 1.0, 2.0, *between, 3.0):
        session.set("denoise", strength=strength)
        assert difference(session.render(), expected[strength]) < 1e-3
    assert events == ["filter", *["edit"] * 4]
    session.set("denoise", strength=1.0)
    session.render()
    del events[:]
    for shares in ({"brightness": 0.0}, {"brightness": 0.4, "colour": 0.7}, {"colour": 0.0}):
        session.set("denoise", **shares)
        step = session.recipe.steps[0]
        assert difference(session.render(), apply_step(step, image).clamp(0, 1)) < 1e-3
    assert events == []


def test_another_tolerance_or_picture_needs_another_filter(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    events = counted(monkeypatch)["recolor"]
    session.load(Recipe((PAIRS["recolor"][0],)))
    session.render()
    for step, change in (
        ("recolor", {"tolerance": 20.0}),
        ("detail", {"alpha": (3.0, 1.0, 1.0, 1.0)}),
        ("colorize", {"strokes": PAIRS["colorize"][0].strokes}),
    ):
        session.set(step, **change)
        assert difference(session.render(), apply_recipe(session.recipe, cat())) < 1
    assert events == ["filter", "edit"] * 4


def test_the_filter_held_is_that_of_the_step_at_work(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    events = counted(monkeypatch)
    early, late = events["recolor"], events["abstract"]
    session.set("abstract", power=0.1)
    for reach in (0.3, 0.5, 0.8):
        session.set("recolor", strokes=PAIRS["recolor"][0].strokes, reach=reach)
        session.render()
    assert early == ["filter", "edit", "edit", "edit"]
    assert late == ["filter", "edit"] * 3  # of another picture each time
    for power in (0.05, 0.02):
        session.set("abstract", power=power)
        session.render()
    assert early == ["filter", "edit", "edit", "edit"]
    assert late == ["filter", "edit"] * 4 + ["edit"]


def test_strokes_beside_the_photograph_are_refused(session: Session) -> None:
    session.set("recolor", strokes=(Stroke(((1.8, 1.8),), 0.04, "#2040e0"),))
    with pytest.raises(ValueError, match="strokes of recolor must cover a pixel of the photograph"):
        session.render()


def test_a_slider_moves_without_the_operator(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    session.render()
    monkeypatch.setattr("nlfilter_torch.photo.app.preview.operator_of_sample", None)
    session.set("detail", alpha=(2.0, 1.0, 1.0, 1.0))
    assert difference(session.render(), apply_recipe(session.recipe, cat())) < 1
    session.set("detail", bandwidth=12.0)
    with pytest.raises(TypeError):
        session.render()


@pytest.mark.parametrize("size", [(100, 150), (1000, 1500), (1600, 2400)])
def test_a_preview_is_of_the_viewing_size(size: tuple[int, int]) -> None:
    preview = Preview(torch.zeros(1, 1, *size))
    assert preview.size == viewed_size(size, EDITS["detail"]["viewing_size"].default)
    assert preview.pixels.shape[-2:] == preview.size
    assert preview.stride == pytest.approx(max(1, size[0] * size[1] / PIXELS) ** 0.5, rel=1e-3)


def test_sampled_operator_is_a_sample_of_the_whole() -> None:
    image = reduce_channels(cat(1), "luminance")  # 300x450
    bandwidth = float(estimate_bandwidth(image))
    alpha = torch.tensor([3.0, 3.0, 4.0, 1.05])
    whole = polynomial_filter(nonlocal_operator(image, photometric_bandwidth=bandwidth), image, alpha)
    for stride in (1, 2, 3):
        first = (stride - 1) // 2
        operator = operator_of_sample(
            image,
            stride,
            Step("detail", landmarks=100),
            bandwidth=bandwidth,
            distance=None,
            channels="luminance",
            patch_size=5,
        )
        height, width = operator.size
        assert operator.size == (300 // stride, 450 // stride)
        points = image[..., first::stride, first::stride][..., :height, :width]
        filtered = polynomial_filter(operator, points, alpha)
        wanted = whole[..., first::stride, first::stride][..., :height, :width]
        assert (filtered - wanted).square().mean().sqrt() * 255 < 1.0
        assert (wanted - points).square().mean().sqrt() * 255 > 15


def test_sampled_operator_in_colour_and_nearby() -> None:
    """As close as the whole operator with other landmarks; half or twice the spatial bandwidth gives 2.4 levels."""
    image = cat(1)
    options = {"patch_size": 3, "photometric_bandwidth": 0.1, "spatial_bandwidth": 60.0, "num_landmarks": 200}
    whole = nonlocal_operator(image, guide_channels="all", **options) @ image  # type: ignore[arg-type]
    detail = Step("detail", landmarks=200, spatial_bandwidth=60.0, patch_size=3)
    operator = operator_of_sample(image, 2, detail, bandwidth=0.1, distance=60.0, channels="all", patch_size=3)
    filtered, wanted = operator @ image[..., ::2, ::2], whole[..., ::2, ::2]
    assert (filtered - wanted).square().mean().sqrt() * 255 < 0.8


LOOKED_AT = {"viewing_size": 0.004, "landmarks": 60}  # megapixels, of previews in these tests
ABOVE = {"alpha": (2.0, 2.0, 2.0, 1.0), **LOOKED_AT}


def rms(a: torch.Tensor, b: torch.Tensor) -> float:
    """In grey levels of 255."""
    return float((a - b).square().mean().sqrt()) * 255


# Measured: 0.80, 0.68, 1.25, 0.35, for the fast preview, which edits the reduced photograph; see docs/editing.md.
@pytest.mark.parametrize(
    ("step", "limit"),
    [
        (Step("detail", limits="none", **ABOVE), 0.9),
        (Step("detail", **ABOVE), 0.8),
        (Step("detail", (Stroke(HERE, 0.04, "in"),), inside=(3.0, 2.0, 2.0, 1.0), **ABOVE), 1.35),
        (Step("tone", contrast=1.2, clarity=2.0, **LOOKED_AT), 0.5),
    ],
)
def test_preview_of_a_large_photograph_shows_what_saving_gives(step: Step, limit: float) -> None:
    image, recipe = resize(cat(1), (140, 209)).clamp(0, 1), Recipe((step,))
    preview = Preview(image, pixels=4000)
    assert preview.stride == pytest.approx(2.7, rel=0.02)
    saved = resize(apply_recipe(recipe, image).clamp(0, 1), preview.size).clamp(0, 1)
    assert rms(preview.pixels, saved) > 3
    assert rms(preview.render(recipe), saved) < limit


# Where no pixel comes near its limits. Measured: 0.03, 0.01, 0.05, 0.05, 0.35 and 0.05. Strokes are drawn anew at the
# size of the preview, with a radius of 3 pixels; cuts between colours depend on them: 0.06 with those of saving.
@pytest.mark.parametrize(
    ("step", "limit"),
    [
        (Step("detail", **ABOVE), 0.1),
        (Step("tone", contrast=1.2, clarity=2.0, **LOOKED_AT), 0.1),
        (Step("sharpen", **LOOKED_AT), 0.1),
        (Step("abstract", **LOOKED_AT), 0.1),
        (Step("colorize", (Stroke(HERE, 0.06, "#606880"), Stroke(THERE, 0.06, "#807060")), viewing_size=0.004), 0.4),
        (Step("recolor", (Stroke(HERE, 0.06, "#606880"),)), 0.1),
    ],
)
def test_preview_of_a_soft_photograph_shows_what_saving_gives(
    step: Step, limit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.selections.mask.VIEWED", LOOKED_AT["viewing_size"])
    image, recipe = 0.3 + 0.4 * resize(cat(1), (140, 209)).clamp(0, 1), Recipe((step,))
    preview = Preview(image, pixels=4000)
    saved = resize(apply_recipe(recipe, image), preview.size)
    assert rms(preview.pixels, saved) > 1.5
    assert rms(preview.render(recipe), saved) < limit


def test_masks_are_those_of_the_library_and_need_no_other_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    image = cat()
    first, second = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in"), Stroke(((0.8, 0.8),), 0.04, "out")
    preview, size = Preview(image), (image.shape[-2], image.shape[-1])
    inner, outer = mask_of((first,), size), mask_of((second,), size)
    near = partial(region_mask, image, inner, extent="near")  # the default of the edit
    wanted = [near(generator=seeded()), near(outer, generator=seeded())]
    assert torch.equal(preview.masks(Step("detail", (first,))), wanted[0])
    monkeypatch.setattr("nlfilter_torch.photo.picture.in_memory.operator_from_guide", None)
    assert torch.equal(preview.masks(Step("detail", (first, second), landmarks=400)), wanted[1])
    assert not torch.equal(preview.masks(Step("detail", (first, second), reach=0.9)), wanted[1])
    with pytest.raises(TypeError):
        preview.masks(Step("detail", (first, second), tolerance=20.0))


def test_areas_are_means() -> None:
    image = cat(1)
    assert reduce(image, 1) is image
    assert torch.allclose(reduce(image, 3), F.interpolate(image, scale_factor=1 / 3, mode="area"), atol=1e-6)


TWO = torch.full((1, 3, 60, 90), 0.5) + torch.tensor([0.3, -0.2, -0.2]).view(1, 3, 1, 1)
TWO[..., 48:] = torch.tensor([0.1, 0.5, 0.2]).view(1, 3, 1, 1)
ACROSS = Stroke(((0.22, 0.5), (0.61, 0.5)), 0.02, "#2040e0")  # from the red into the green


def test_results_are_kept_while_picture_and_scribbles_stay() -> None:
    preview, step = Preview(TWO), Step("defocus", (ACROSS,))
    first = preview.ignored(step)
    assert first is not None
    assert first.nonzero()[:, 3].min() >= 44  # the green begins at 48
    assert preview.ignored(step.mixed(on=False, opacity=0.3)) is first
    mask = preview.mask(step)
    assert mask is not None
    assert preview.mask(step.mixed(opacity=0.3)) is mask
    assert ignored(step, torch.full_like(TWO, 0.5)) is None


def test_edits_of_colours_and_of_masks_see_the_same_scribbles() -> None:
    for edit in ("recolor", "defocus", "detail"):
        step = Step(edit, (ACROSS, Region.upright((0.1, 0.1, 0.2, 0.2), "ellipse", "#2040e0")))
        stray, mask = ignored(step, TWO), selected(step, TWO)
        assert stray is not None
        assert stray[..., 48:].any()
        assert mask is not None
        assert mask.shape == (1, 1, 60, 90)
        assert mask[0, 0, 12, 18] > 0.9
    assert selected(Step("tone"), TWO) is None
    assert ignored(Step("tone"), TWO) is None
