"""Steps and recipes applied to an image: they call the functions with the arguments that they stand for."""

from dataclasses import replace

import pytest
import torch

from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo import (
    abstract,
    adjust_tone,
    colorize,
    defocus,
    denoise,
    enhance,
    recolor,
    region_mask,
    sharpen,
)
from nlfilter_torch.photo.declared.parameters import CRISP, EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.applying import (
    EDIT_OF,
    PreparedStep,
    apply_step,
    edit_of,
    filter_key,
    scribbles_of,
    viewed_stride,
)
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.picture.painting import TensorPainter
from tests.strokes import mask_of, paint

SIZE = (48, 64)
LINE = ((0.25, 0.25), (0.5, 0.25))
IN, OUT = Stroke(LINE, 0.05, "in"), Stroke(((0.8, 0.8),), 0.1, "out")
ADD, REMOVE = Stroke(((0.3, 0.7), (0.5, 0.7)), 0.08, "add"), Stroke(((0.4, 0.3),), 0.08, "remove")
BLUE, KEEP = Stroke(LINE, 0.05, "#2040e0"), Stroke(((0.8, 0.8),), 0.1, "out")
ALPHA, INSIDE = (0.5, 1.0, 1.0, 1.0), (3.0, 3.0, 2.0, 1.0)
DETAIL = Step("detail", (IN, OUT), alpha=ALPHA, inside=INSIDE, reach=0.7, bandwidth=30.0)
COLORIZE = Step("colorize", (BLUE,), strength=0.5)
RECOLOR = Step("recolor", (BLUE, KEEP), reach=0.5, tolerance=20.0)
DEFOCUS = Step("defocus", (IN,), radius=4.0)
ABSTRACT = Step("abstract", power=0.2, edges=0.5, edge_width=0.3, tones=5)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_detail(pixels: torch.Tensor) -> None:
    wanted = enhance(pixels, torch.tensor(ALPHA), photometric_bandwidth=30 / 255, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((Step("detail", alpha=ALPHA, bandwidth=30.0),)), pixels), wanted)


def test_detail_in_a_region_and_elsewhere(pixels: torch.Tensor) -> None:
    plain = DETAIL.changed(limits="none", threshold=0.0)
    edited = apply_recipe(Recipe((plain,)), pixels)
    regions = mask_of([IN], SIZE), mask_of([OUT], SIZE)
    mask = region_mask(pixels, *regions, extent="near", reach=0.7, generator=seeded())
    operator = nonlocal_operator(
        reduce_channels(pixels, "luminance"),
        photometric_bandwidth=30 / 255,
        spatial_bandwidth=min(SIZE) / 12,
        num_landmarks=300,
        generator=seeded(),
    )

    def edit(luminance: torch.Tensor) -> torch.Tensor:
        inside, outside = (polynomial_filter(operator, luminance, torch.tensor(a)) for a in (INSIDE, ALPHA))
        return mask * inside + (1 - mask) * outside

    assert torch.allclose(edited, edit_luminance(pixels, edit), atol=1e-5)
    # With the same sliders inside and outside, the edit is that of the whole picture.
    same = apply_recipe(Recipe((plain.changed(inside=ALPHA),)), pixels)
    whole = Step("detail", alpha=ALPHA, bandwidth=30.0, limits="none", threshold=0.0)
    assert torch.allclose(same, apply_recipe(Recipe((whole,)), pixels), atol=1e-5)


@pytest.mark.parametrize("step", [DETAIL, COLORIZE, Step("defocus", (IN,))])
def test_strokes_outside_the_picture_are_refused(step: Step, pixels: torch.Tensor) -> None:
    beside = tuple(Stroke(((1.5, 1.5),), stroke.radius, stroke.paint) for stroke in step.strokes)
    with pytest.raises(ValueError, match=f"strokes of {step.edit} must cover a pixel of the photograph, got none"):
        apply_recipe(Recipe((step.changed(strokes=beside),)), pixels)


def test_colours(pixels: torch.Tensor) -> None:
    strokes, painted = paint([BLUE], SIZE)
    grey = reduce_channels(pixels, "luminance")
    wanted = colorize(grey, strokes, painted, strength=0.5, generator=seeded())
    for image in (pixels, grey):
        assert torch.equal(apply_recipe(Recipe((COLORIZE,)), image), wanted)
    kept = recolor(
        pixels,
        strokes,
        painted,
        keep=mask_of([KEEP], SIZE),
        reach=0.5,
        photometric_bandwidth=0.2,
        generator=seeded(),
    )
    assert torch.equal(apply_recipe(Recipe((RECOLOR,)), pixels), kept)
    with pytest.raises(ValueError, match="recolor needs a colour photograph"):
        apply_recipe(Recipe((RECOLOR,)), grey)


def test_blur_and_painting(pixels: torch.Tensor) -> None:
    blurred = defocus(pixels, mask_of([IN], SIZE), radius=0.04 * 48, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((DEFOCUS,)), pixels), blurred)
    behind = defocus(pixels, mask_of([IN], SIZE), background=mask_of([OUT], SIZE), radius=0.04 * 48, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((DEFOCUS.changed(strokes=(IN, OUT)),)), pixels), behind)
    assert not torch.equal(behind, blurred)
    for line, width in ((0.3, 0.3), (2.0, 0.96)):  # lines have a minimum width in pixels
        step = ABSTRACT.changed(edge_width=line)
        wanted = abstract(pixels, power=0.2, edges=0.5, edge_width=width, tones=5, generator=seeded())
        assert torch.equal(apply_recipe(Recipe((step,)), pixels), wanted)


def test_steps_follow_one_another(pixels: torch.Tensor) -> None:
    """Steps are applied in their order, also several of the same edit."""
    crisp = Step("detail", alpha=INSIDE)
    for steps in ((crisp, DEFOCUS), (DEFOCUS, crisp), (crisp, Step("tone", clarity=2.0), crisp)):
        wanted = pixels
        for step in steps:
            wanted = apply_recipe(Recipe((step,)), wanted.clamp(0, 1))
        assert torch.equal(apply_recipe(Recipe(steps), pixels), wanted)
        assert Recipe.from_json(Recipe(steps).to_json(), "edit.json") == Recipe(steps)


def test_the_other_edits_are_steps(pixels: torch.Tensor) -> None:
    sharp = sharpen(pixels, amount=6.0, guide_blur=0.8, patch_size=3, generator=seeded())
    assert torch.equal(
        apply_recipe(Recipe((Step("sharpen", amount=6.0, guide_blur=0.8, patch_size=3),)), pixels), sharp
    )
    toned = adjust_tone(pixels, contrast=1.2, clarity=2.0, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((Step("tone", clarity=2.0),)), pixels), toned)
    for level in (None, 12.0):
        clean = denoise(pixels, noise_level=None if level is None else level / 255, generator=seeded())
        assert torch.equal(apply_recipe(Recipe((Step("denoise", noise_level=level),)), pixels), clean)


def test_all_options_of_detail_are_in_files(pixels: torch.Tensor) -> None:
    step = Step("detail", residual=0.5, channels="all", patch_size=3)
    assert Recipe.from_json(Recipe((step,)).to_json(), "edit.json") == Recipe((step,))
    alpha = torch.tensor(CRISP)
    wanted = enhance(pixels, alpha, residual=0.5, channels="all", patch_size=3, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((step,)), pixels), wanted)


def test_gradient_reaches_the_image() -> None:
    image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0)).requires_grad_()
    apply_recipe(PRESETS["glow"], image).square().mean().backward()
    assert image.grad is not None
    assert image.grad.abs().max() > 0


def test_a_prepared_picture_gives_the_same_for_any_step(pixels: torch.Tensor) -> None:
    prepared = PreparedStep(pixels)
    for alpha in (ALPHA, INSIDE):
        step = DETAIL.changed(alpha=alpha)
        assert torch.equal(prepared(step), apply_step(step, pixels))
    assert prepared(DETAIL).dtype == pixels.dtype


def test_steps_with_equal_filters_share_them() -> None:
    key = filter_key(DETAIL)
    assert filter_key(DETAIL.changed(alpha=INSIDE, strokes=())) == key
    assert filter_key(DETAIL.changed(bandwidth=31.0)) != key
    assert filter_key(DETAIL.changed(landmarks=299)) != key


def test_pixels_of_a_preview_are_counted_at_the_viewing_size() -> None:
    size = (300, 400)
    for step in (Step("detail"), Step("defocus", (IN,))):
        assert viewed_stride(step, size, 1) == 1
    assert viewed_stride(Step("defocus", (IN,)), size, 5) == 5  # it counts pixels of the photograph
    # A photograph of 1500 x 2000 is viewed in 1061 x 1414.
    assert viewed_stride(Step("detail"), size, 5) == pytest.approx(5 * 1061 / 1500)
    assert viewed_stride(Step("detail", viewing_size=0), size, 5) == 5


def test_edits_have_the_settings_of_their_steps() -> None:
    assert tuple(EDIT_OF) == tuple(EDITS)
    edit = edit_of(Step("defocus", (IN,), radius=4.0), SIZE)
    assert vars(edit)["radius"] == 0.04 * 48
    assert torch.equal(torch.rand(3, generator=edit.options.generator), torch.rand(3, generator=seeded()))
    own = torch.Generator().manual_seed(7)
    assert edit_of(Step("tone"), SIZE, generator=own).options.generator is own


@pytest.mark.parametrize(
    ("step", "strokes", "names"),
    [
        (DEFOCUS, (IN, ADD, REMOVE), ["focus_region", "added", "removed"]),
        (DEFOCUS, (ADD,), ["added"]),
        (DETAIL, (ADD, REMOVE), ["added", "removed"]),
        (RECOLOR, (BLUE, REMOVE, replace(ADD, paint="add #c04020")), ["added", "removed"]),
        (RECOLOR, (replace(ADD, paint="add #c04020"),), ["added"]),
    ],
)
def test_a_step_has_a_mask_painted_by_hand(
    step: Step, strokes: tuple[Stroke, ...], names: list[str], pixels: torch.Tensor
) -> None:
    painted = step.changed(strokes=strokes)
    recipe = Recipe((painted,))
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe
    drawn = scribbles_of(painted, SIZE, TensorPainter())
    assert list(drawn.masks) == names
    edited = apply_recipe(recipe, pixels)
    assert edited.isfinite().all()
    assert not torch.equal(edited, pixels)
    erased = painted.changed(strokes=(*strokes, replace(REMOVE, points=((0.0, 0.5), (1.0, 0.5)), radius=1.0)))
    if step is RECOLOR:
        wanted = pixels
    elif step is DETAIL:  # as outside the region
        outside = Step("detail", alpha=ALPHA, bandwidth=30.0)
        wanted = apply_recipe(Recipe((outside,)), pixels)
    else:
        wanted = defocus(pixels, None, added=torch.zeros(1, 1, *SIZE), radius=0.04 * 48, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((erased,)), pixels), wanted)


def test_an_eraser_alone_changes_nothing() -> None:
    assert not DEFOCUS.changed(strokes=(REMOVE,)).changes()
    assert not DETAIL.changed(strokes=(REMOVE,)).has_region()


def test_scribbles_are_painted_under_the_names_of_the_arguments() -> None:
    painter = TensorPainter()
    assert scribbles_of(Step("tone"), SIZE, painter).masks == {}
    recoloured = scribbles_of(RECOLOR, SIZE, painter)
    colours, painted = paint([BLUE], SIZE)
    assert recoloured.colours is not None
    assert torch.equal(recoloured.colours, torch.cat([colours, painted], dim=1))
    assert torch.equal(recoloured.masks["keep"], mask_of([KEEP], SIZE, above=[BLUE]))
    regional = scribbles_of(DETAIL, SIZE, painter)
    assert list(regional.masks) == ["regions", "negative"]
    assert regional.sliders is not None
    assert regional.outside is not None
    assert regional.sliders.tolist() == [list(INSIDE)]
    assert regional.outside.tolist() == list(ALPHA)
    hidden = Stroke(IN.points, 0.01, "out")  # wholly under the strokes on the subject
    assert list(scribbles_of(DEFOCUS.changed(strokes=(IN, hidden)), SIZE, painter).masks) == ["focus_region"]


def test_progress_is_reported_before_every_acting_step(pixels: torch.Tensor) -> None:
    reports: list[tuple[int, int]] = []
    steps = (Step("tone", clarity=2.0), Step.idle("detail"), ABSTRACT)
    apply_recipe(Recipe(steps), pixels, lambda done, total: reports.append((done, total)))
    assert reports == [(0, 2), (1, 2)]


def test_steps_of_integers_are_limited_to_black_and_white() -> None:
    greys = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # a matrix that leaves colours as they are
    strong, weak = (Step("look", matrix=tuple(factor * value for value in greys)) for factor in (4, 0.5))
    image = torch.rand(2, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    image[1] *= 3
    edited = apply_recipe(Recipe((strong, weak)), image)
    assert edited[0].max() == 0.5
    assert edited[1].max() == pytest.approx(0.5 * float(image[1].max()))
