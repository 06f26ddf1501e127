"""Recipes: applying them to an image, their files, and the command ``apply``."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import skimage.data
import torch

from nlfilter_torch import abstract, adjust_tone, colorize, defocus, denoise, enhance, recolor, region_mask, sharpen
from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.parameters import CRISP, EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step, working_bytes
from nlfilter_torch.photo.declared.strokes import Stroke, thin
from nlfilter_torch.photo.edits.applying import apply_recipe
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.picture.painting import cover, mask_of, paint

SIZE = (48, 64)
LINE = ((0.25, 0.25), (0.5, 0.25))
IN, OUT = Stroke(LINE, 0.05, "in"), Stroke(((0.8, 0.8),), 0.1, "out")
BLUE, KEEP = Stroke(LINE, 0.05, "#2040e0"), Stroke(((0.8, 0.8),), 0.1, "keep")
ALPHA, INSIDE = (0.5, 1.0, 1.0, 1.0), (3.0, 3.0, 2.0, 1.0)
DETAIL = Step("detail", (IN, OUT), alpha=ALPHA, inside=INSIDE, reach=0.7, bandwidth=30.0)
COLORIZE = Step("colorize", (BLUE,), strength=0.5)
RECOLOR = Step("recolor", (BLUE, KEEP), reach=0.5, tolerance=20.0)
DEFOCUS = Step("defocus", (IN,), radius=4.0)
ABSTRACT = Step("abstract", power=0.2, edges=0.5, edge_width=0.3, tones=5)
WHOLE = Recipe((DETAIL, COLORIZE, RECOLOR, DEFOCUS, ABSTRACT))


@pytest.fixture(scope="module")
def pixels() -> torch.Tensor:
    """(1, 3, 48, 64) in [0, 1]: a piece of the cat."""
    return torch.from_numpy(skimage.data.chelsea()[80:128, 120:184].copy()).permute(2, 0, 1)[None].float() / 255


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_a_stroke_covers_what_is_nearer_than_its_radius() -> None:
    covered = cover(IN, SIZE)
    y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    across = torch.maximum((16 - x).clamp(min=0), (x - 32).clamp(min=0))
    assert torch.equal(covered, torch.hypot(across, y - 12) <= 0.05 * 48)
    dot = cover(Stroke(((0.5, 0.5),), 1e-6, "in"), (49, 65))
    assert dot.sum() == 1
    assert dot[24, 32]


def test_strokes_that_leave_the_picture_cover_what_is_in_it() -> None:
    crossing = cover(Stroke(((-0.5, 0.5), (1.5, 0.5)), 0.05, "in"), SIZE)
    assert torch.equal(crossing.any(1).nonzero().flatten(), torch.arange(22, 26))
    assert crossing[22:26].all()
    assert not cover(Stroke(((1.5, 1.5),), 0.05, "in"), SIZE).any()


def test_a_larger_picture_is_painted_alike() -> None:
    small, large = mask_of([IN], SIZE), mask_of([IN], (480, 640))
    assert (torch.nn.functional.avg_pool2d(large, 10) - small).abs().mean() < 0.01


def test_later_paint_covers_earlier() -> None:
    colours, painted = paint([BLUE, replace(BLUE, paint="#ff0000", points=LINE[:1])], SIZE)
    assert torch.equal(colours[0, :, 12, 16], torch.tensor([1.0, 0.0, 0.0]))
    assert torch.allclose(colours[0, :, 12, 30], torch.tensor([0x20, 0x40, 0xE0]) / 255)
    assert torch.equal(painted, mask_of([BLUE], SIZE))


def test_thinning_keeps_the_ends() -> None:
    line = [(i / 1000, 0.0) for i in range(501)]
    kept = thin(line, 0.1)
    assert kept[0] == (0.0, 0.0)
    assert kept[-1] == (0.5, 0.0)
    assert len(kept) == 6


def test_detail(pixels: torch.Tensor) -> None:
    wanted = enhance(pixels, torch.tensor(ALPHA), photometric_bandwidth=30 / 255, generator=seeded())
    assert torch.equal(apply_recipe(Recipe((Step("detail", alpha=ALPHA, bandwidth=30.0),)), pixels), wanted)


def test_detail_in_a_region_and_elsewhere(pixels: torch.Tensor) -> None:
    plain = DETAIL.changed(limits="none", threshold=0.0)
    found = apply_recipe(Recipe((plain,)), pixels)
    regions = mask_of([IN], SIZE), mask_of([OUT], SIZE)
    mask = region_mask(pixels, *regions, reach=0.7, generator=seeded())
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

    assert torch.allclose(found, edit_luminance(pixels, edit), atol=1e-5)
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


@pytest.mark.parametrize("edit", EDITS)
def test_idle_steps_change_nothing(edit: str, pixels: torch.Tensor) -> None:
    assert not Step.idle(edit).changes()
    assert apply_recipe(Recipe((Step.idle(edit),)), pixels) is pixels
    changed: dict[str, Any] = {"matrix": (0.5,) * 9} if edit == "look" else {}  # the default look changes nothing
    assert Step(edit, (BLUE, IN), **changed).changes()


def test_what_changes_nothing_is_left_out(pixels: torch.Tensor) -> None:
    idle = Recipe((Step.idle("detail").changed(inside=INSIDE), Step("recolor", (KEEP,))))
    assert apply_recipe(idle, pixels) is pixels
    assert Recipe.from_json(idle.to_json(), "edit.json") == Recipe()


def test_files_hold_the_whole_edit() -> None:
    assert Recipe.from_json(WHOLE.to_json(), "edit.json") == WHOLE
    entries = json.loads(WHOLE.to_json())
    assert list(entries) == ["version", "steps"]
    assert [step["edit"] for step in entries["steps"]] == ["detail", "colorize", "recolor", "defocus", "abstract"]


def test_colours_may_be_written_in_capitals() -> None:
    stroke = replace(BLUE, paint=BLUE.paint.upper())
    assert torch.equal(paint([stroke], (9, 9))[0], paint([BLUE], (9, 9))[0])
    recipe = Recipe((Step("recolor", (stroke,)),))
    assert Recipe.from_json(recipe.to_json(), "edit.json") == recipe


def test_presets_are_edits(tmp_path: Path) -> None:
    crisp = PRESETS["crisp"]
    assert find_recipe("crisp") == crisp
    path = tmp_path / "look.json"
    path.write_text(crisp.to_json())
    assert find_recipe(str(path)) == crisp


def step_file(edit: str, entries: str) -> str:
    """A file with a single step."""
    return f'{{"version": 1, "steps": [{{"edit": "{edit}", {entries}}}]}}'


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", "it is not JSON"),
        ("[1]", "it must hold a list of steps"),
        ('{"detial": {}}', "it must hold a list of steps"),
        ('{"detail": {}}', "edit.json is not a preset: it must hold a list of steps"),
        ('{"alpha": [2, 1]}', "edit.json is not a preset: it must hold a list of steps"),
        (step_file("detail", '"power": 1'), "must have no entries other than alpha"),
        (
            step_file("abstract", '"strokes": []'),
            "must have no entries other than power, edges, edge_width, tones, .*, got strokes",
        ),
        (step_file("abstract", '"tones": 2.5'), "tones of abstract, step 1 in edit.json must be a whole number"),
        (
            step_file("recolor", '"reach": 1'),
            "reach of recolor, step 1 in edit.json must be a number from 0 to 0.999, got 1",
        ),
        (
            step_file("detail", '"inside": [1, 1]'),
            "inside of detail, step 1 in edit.json must have as many numbers as alpha",
        ),
        ('{"steps": []}', "version in edit.json must be 1, got null"),
        (
            '{"version": 2, "steps": []}',
            "version in edit.json must be 1, got 2; update nlfilter-torch to read newer files",
        ),
        ('{"version": 1, "steps": {}}', "steps in edit.json must be a list"),
        ('{"version": 1, "steps": [], "detail": {}}', "no entries other than version and steps, got detail"),
        ('{"version": 1, "steps": [{}]}', "step 1 in edit.json must have an entry edit, one of denoise, detail"),
        ('{"version": 1, "steps": [{"edit": ["tone"]}]}', "step 1 in edit.json must have an entry edit"),
        (
            '{"version": 1, "steps": [{"edit": "tone"}, {"edit": "tone", "clarity": "1"}]}',
            'clarity of tone, step 2 in edit.json must be a number from -1000000 to 1000000, got "1"',
        ),
        (step_file("defocus", '"strokes": {}'), "strokes of defocus, step 1 in edit.json must be a list"),
        (step_file("defocus", '"strokes": [{"points": []}]'), "must have the entries points, radius and paint"),
        (
            step_file("defocus", '"strokes": [{"points": [], "radius": 0.1, "paint": "in"}]'),
            "points of a stroke in defocus, step 1 in edit.json must be pairs of numbers",
        ),
        (
            step_file("defocus", '"strokes": [{"points": [[0, 3]], "radius": 0.1, "paint": "in"}]'),
            r"must be pairs of numbers, shares of width and height from -2 to 2, got \[\[0, 3\]\]",
        ),
        (
            step_file("defocus", '"strokes": [{"points": [[0, NaN]], "radius": 0.1, "paint": "in"}]'),
            "points of a stroke in defocus, step 1 in edit.json must be pairs of numbers",
        ),
        (
            step_file("defocus", '"strokes": [{"points": [[0, 0]], "radius": 2, "paint": "in"}]'),
            r"radius of a stroke in defocus, step 1 in edit.json must be in \(0, 1\], got 2",
        ),
        (
            step_file("recolor", '"strokes": [{"points": [[0, 0]], "radius": 0.1, "paint": "blue"}]'),
            "must be one of a colour such as #c04020, keep, got 'blue'",
        ),
    ],
)
def test_files_that_hold_no_edit(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Recipe.from_json(text, "edit.json")


def test_apply(pixels: torch.Tensor, tmp_path: Path) -> None:
    photo, edit, out = tmp_path / "in.png", tmp_path / "edit.json", tmp_path / "out.png"
    write_photograph(Photograph(pixels), photo)
    recipe = Recipe((DETAIL, Step("tone"), DEFOCUS))
    edit.write_text(recipe.to_json())
    assert main(["apply", str(photo), str(out), "--preset", str(edit)]) == 0
    assert (read_photograph(out).pixels - apply_recipe(recipe, pixels).clamp(0, 1)).abs().max() < 0.6 / 255

    assert main(["apply", str(photo), str(out), "--preset", "crisp", "--depth", "16"]) == 0
    assert main(["detail", str(photo), str(tmp_path / "same.png"), "--preset", "crisp", "--depth", "16"]) == 0
    assert torch.equal(read_photograph(out).pixels, read_photograph(tmp_path / "same.png").pixels)


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (Step.idle("tone"), "edit.json holds no step that changes anything: the photograph is written as it is"),
        (COLORIZE, "in.png is in colour: colorize replaces its colours everywhere by those of the scribbles"),
    ],
    ids=["idle", "colorize"],
)
def test_apply_notes(
    pixels: torch.Tensor,
    tmp_path: Path,
    step: Step,
    sentence: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_photograph(Photograph(pixels), tmp_path / "in.png")
    (tmp_path / "edit.json").write_text(Recipe((step,)).to_json(drawn=True))
    files = [str(tmp_path / name) for name in ("in.png", "out.png", "edit.json")]
    assert main(["apply", *files[:2], "--preset", files[2]]) == 0
    (note,) = capsys.readouterr().err.splitlines()
    assert sentence in note
    assert read_photograph(files[1]).size == (48, 64)


def test_apply_refuses_what_is_no_edit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["apply", "in.png", str(tmp_path / "out.png"), "--preset", "nothing"]) == 2
    assert "nothing is neither a file nor one of the presets" in capsys.readouterr().err


def test_more_memory_is_asked_for_by_hungrier_steps() -> None:
    assert Recipe().bytes_per_pixel == 0
    assert Recipe((RECOLOR, DEFOCUS, COLORIZE)).bytes_per_pixel == working_bytes(100, 5)
    assert Recipe((DETAIL,)).bytes_per_pixel == working_bytes(DETAIL["landmarks"], 5, factors=2)
    assert Recipe((Step("denoise", method="rule", patch_size=9),)).bytes_per_pixel == working_bytes(200, 9)
    assert WHOLE.bytes_per_pixel == max(step.bytes_per_pixel() for step in WHOLE.acting)
