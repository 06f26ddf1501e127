"""Named presets in Python and on the command line, and recipes in files."""

import json
from pathlib import Path

import pytest
import skimage.data
import torch

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import CHARACTERS, LOOKS, PRESETS, PURPOSES, Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.recipes import INSIDE, KEEP, WHOLE


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    pixels = torch.from_numpy(skimage.data.astronaut()[60:140, 180:280].copy()).permute(2, 0, 1)[None].float() / 255
    write_photograph(Photograph(pixels), tmp_path / "photo.png")
    return tmp_path / "photo.png"


def grain(pixels: torch.Tensor) -> torch.Tensor:
    """Squared difference of every pixel from the 3x3 around it, (1, H, W)."""
    return (pixels - torch.nn.functional.avg_pool2d(pixels, 3, 1, 1)).square().mean(1)


@pytest.mark.parametrize("name", PRESETS)
def test_command_and_function_agree(photo: Path, name: str) -> None:
    out = photo.with_name("out.png")
    assert main(["detail", str(photo), str(out), "--preset", name]) == 0
    expected = apply_recipe(PRESETS[name], read_photograph(photo).pixels).clamp(0, 1)
    assert (read_photograph(out).pixels - expected).abs().max() <= 0.51 / 255


def test_each_does_what_it_says(photo: Path) -> None:
    """Grain is measured in the flatter half of the pixels, contrast in all."""
    pixels = read_photograph(photo).pixels
    calm = grain(pixels) <= grain(pixels).median()
    edited = {name: apply_recipe(preset, pixels) for name, preset in PRESETS.items()}
    finer = {name: float(grain(y)[calm].mean() / grain(pixels)[calm].mean()) for name, y in edited.items()}
    contrast = {name: float(y.std() / pixels.std()) for name, y in edited.items()}
    assert min(finer[name] for name in ("crisp", "texture", "dramatic")) > 2
    assert 1.5 < finer["clear"] < 2
    assert max(finer[name] for name in ("soft skin", "smooth", "glow", "calm")) < 0.8
    assert contrast["dramatic"] > contrast["texture"] > 1.02
    assert contrast["glow"] > contrast["soft skin"] > contrast["calm"]
    assert contrast["calm"] < 0.97
    assert contrast["soft skin"] == pytest.approx(1, abs=0.02)


def test_none_takes_light_or_shadow_away() -> None:
    for name in PRESETS:
        pixels = torch.from_numpy(skimage.data.rocket()[::4, ::4].copy()).permute(2, 0, 1)[None].float() / 255
        stored = (255 * apply_recipe(PRESETS[name], pixels).clamp(0, 1)).round() / 255
        newly = ((stored == 0) & (pixels > 4 / 255)) | ((stored == 1) & (pixels < 1 - 4 / 255))
        assert newly.any(1).float().mean() < 0.001
        assert (stored - pixels).mean().abs() < 1 / 255


def test_names_and_files_are_found(photo: Path) -> None:
    assert find_recipe("soft-skin") == find_recipe("Soft_Skin") == PRESETS["soft skin"]
    path = photo.with_name("mine.json")
    mine = Recipe((Step("detail", alpha=(2.0, 1.0), landmarks=30),))
    path.write_text(mine.to_json(complete=True))
    assert find_recipe(str(path)) == mine


def test_an_option_counts_for_more_than_a_name(photo: Path) -> None:
    out = photo.with_name("out.png")
    assert main(["detail", str(photo), str(out), "--preset", "crisp", "--alpha", "1,1"]) == 0
    assert torch.equal(read_photograph(out).pixels, read_photograph(photo).pixels)


def test_an_unknown_name_is_told(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["detail", str(photo), str(photo.with_name("out.png")), "--preset", "crips"]) == 2
    complaint = capsys.readouterr().err
    assert "crips is neither a file nor one of the presets crisp, clear" in complaint
    assert complaint.count("\n") == 1
    assert main(["presets", "crips"]) == 2


def test_the_list_names_them_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert PURPOSES.keys() == PRESETS.keys()
    assert main(["presets"]) == 0
    listed = capsys.readouterr().out
    for name in PRESETS:
        assert name in listed


def test_one_is_printed_as_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["presets", "soft-skin"]) == 0
    assert Recipe.from_json(capsys.readouterr().out, "it") == PRESETS["soft skin"]


def test_what_changes_nothing_is_left_out(pixels: torch.Tensor) -> None:
    idle = Recipe((Step.idle("detail").changed(inside=INSIDE), Step("recolor", (KEEP,))))
    assert apply_recipe(idle, pixels) is pixels
    assert Recipe.from_json(idle.to_json(), "edit.json") == Recipe()


def test_files_hold_the_whole_edit() -> None:
    assert Recipe.from_json(WHOLE.to_json(), "edit.json") == WHOLE
    off = Recipe((Step("tone").mixed(on=False), Step("sharpen").mixed(opacity=0.0)))  # they may be wanted again
    assert Recipe.from_json(off.to_json(), "edit.json") == off
    entries = json.loads(WHOLE.to_json())
    assert list(entries) == ["version", "steps"]
    assert [step["edit"] for step in entries["steps"]] == ["detail", "colorize", "recolor", "defocus", "abstract"]


def test_a_step_that_is_chosen_stays_chosen() -> None:
    recipe = Recipe((Step("tone"), Step("detail"), Step("tone", clarity=2.0))).choosing(0)
    assert recipe == recipe.choosing(2)
    assert recipe.current("tone") == Step("tone")
    assert recipe.current("detail") == Step("detail")
    changed = recipe.with_current(Step("tone", contrast=0.8))
    assert changed.steps[0] == changed.current("tone") == Step("tone", contrast=0.8)
    more = changed.with_current(Step("denoise"))  # it comes first
    assert (more.chosen, more.current("tone")) == (1, changed.steps[0])
    assert more.moved(1, 3).current("tone") == changed.steps[0]
    assert more.moved(3, 0).current("tone") == changed.steps[0]
    assert more.replaced(0).current("tone") == changed.steps[0]
    assert more.replaced(1).current("tone") == Step("tone", clarity=2.0)


def test_steps_are_replaced_and_moved() -> None:
    recipe = Recipe((Step("tone"), Step("sharpen"), Step("tone", clarity=2.0)))
    assert recipe.place_of("tone") == 2
    assert recipe.place_of("detail") is None
    assert recipe.replaced(1).steps == (recipe.steps[0], recipe.steps[2])
    assert recipe.replaced(1, Step("detail")).steps[1] == Step("detail")
    assert recipe.moved(2, 0).steps == (recipe.steps[2], *recipe.steps[:2])
    assert recipe.moved(0, 1).moved(1, 0) == recipe


def test_presets_are_edits(tmp_path: Path) -> None:
    crisp = PRESETS["crisp"]
    assert find_recipe("crisp") == crisp
    path = tmp_path / "look.json"
    path.write_text(crisp.to_json())
    assert find_recipe(str(path)) == crisp


def step_file(edit: str, entries: str) -> str:
    """A file with a single step."""
    return f'{{"version": 1, "steps": [{{"edit": "{edit}", {entries}}}]}}'


NO_EDITS = [
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
    ('{"version": 1, "steps": [], "detail": {}}', "no entries other than version, develop and steps, got detail"),
    (
        '{"version": 1, "steps": [{}]}',
        "step 1 in edit.json must have an entry edit, one of heal, denoise, light, detail",
    ),
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
        "must be one of a colour such as #c04020, out, box with a colour such as box #c04020, add .*, got 'blue'",
    ),
]


def test_files_that_hold_no_edit() -> None:
    for text, sentence in NO_EDITS:
        with pytest.raises(ValueError, match=sentence):
            Recipe.from_json(text, "edit.json")


def test_looks_are_presets() -> None:
    assert list(LOOKS) == list(CHARACTERS)
    assert not LOOKS.keys() & PRESETS.keys()
    for name, look in LOOKS.items():
        assert find_recipe(name.upper()) == Recipe((look,))
