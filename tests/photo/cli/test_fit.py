"""``nlfilter-torch fit`` and ``detail --preset``: an edit is saved to a file and applied to another photograph."""

import json
import re
from pathlib import Path

import pytest
import torch

from nlfilter_torch.photo import apply_look
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from tests.commands import refusal
from tests.looks import ALPHA, CAT, CUP, SEPIA, explained, in_bytes, rgb


@pytest.fixture
def before(tmp_path: Path) -> Path:
    write_photograph(Photograph(CAT), tmp_path / "before.png")
    return tmp_path / "before.png"


def edit(before: Path, name: str = "after.png", *options: object) -> Path:
    after = before.with_name(name)
    sliders = ",".join(map(str, ALPHA))
    plain = ("--landmarks", "40", "--limits", "none", "--threshold", "0")  # a linear edit can be fitted exactly
    assert main(["detail", str(before), str(after), "--alpha", sliders, *plain, *map(str, options)]) == 0
    return after


def fit(*arguments: object) -> int:
    return main(["fit", *map(str, arguments), "--landmarks", "40"])


def test_fit_finds_the_sliders_and_how_much_they_explain(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    preset = before.with_name("look.json")
    assert fit(before, edit(before), preset) == 0
    printed = capsys.readouterr().out
    step = Recipe.from_json(preset.read_text(), "look.json").steps[0]
    assert step["alpha"] == pytest.approx(ALPHA, rel=0.02)
    assert (step.edit, step["limits"], step["threshold"], step["landmarks"]) == ("detail", "none", 0.0, 40)
    explained = float(printed.split("explained: ")[1].split(" %")[0])
    assert explained > 99.0
    assert str(preset) in printed


@pytest.mark.parametrize(("name", "options"), [("after.tif", ("--depth", "float")), ("after.png", ("--depth", 16))])
def test_fit_reads_every_depth(before: Path, name: str, options: tuple[object, ...]) -> None:
    preset = before.with_name("look.json")
    assert fit(before, edit(before, name, *options), preset) == 0
    assert json.loads(preset.read_text())["steps"][0]["alpha"] == pytest.approx(ALPHA, rel=0.02)


def test_an_edit_of_another_kind_is_explained_in_part(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    after = before.with_name("after.png")
    pixels = read_photograph(before).pixels
    brighter = pixels.clone()
    brighter[..., :40, :] = brighter[..., :40, :] + 0.1  # the filter does not depend on position
    write_photograph(Photograph(brighter), after)
    assert fit(before, after, before.with_name("look.json"), "--bandwidth", 10) == 0
    explained = float(capsys.readouterr().out.split("explained: ")[1].split(" %")[0])
    assert 0 < explained < 90


def test_a_preset_is_the_edit(before: Path) -> None:
    preset, after = before.with_name("look.json"), edit(before)
    assert fit(before, after, preset) == 0
    again, other = before.with_name("again.png"), before.with_name("other.png")
    assert main(["detail", str(before), str(again), "--preset", str(preset)]) == 0
    difference = read_photograph(again).pixels - read_photograph(after).pixels
    assert difference.abs().max() <= 1.01 / 255
    assert (difference != 0).float().mean() < 0.01

    write_photograph(Photograph(rgb("chelsea", slice(150, 200), slice(200, 260))), other)
    by_preset = before.with_name("by-preset.png")
    assert main(["detail", str(other), str(by_preset), "--preset", str(preset)]) == 0
    by_options = edit(other, "by-options.png")
    assert (read_photograph(by_preset).pixels - read_photograph(by_options).pixels).abs().max() <= 1.01 / 255


def test_options_count_for_more_than_the_preset(before: Path) -> None:
    preset = before.with_name("look.json")
    preset.write_text(Recipe((Step("detail", alpha=ALPHA, landmarks=40),)).to_json())
    out = before.with_name("out.png")
    assert main(["detail", str(before), str(out), "--preset", str(preset), "--alpha", "1,1"]) == 0
    assert torch.equal(read_photograph(out).pixels, read_photograph(before).pixels)


def detail_file(entries: str) -> str:
    """A preset with a single step of ``detail``, with the given entries."""
    return f'{{"version": 1, "steps": [{{"edit": "detail", {entries}}}]}}'


def test_preset_keeps_every_entry() -> None:
    values = {"alpha": (3.0, 0.25, 1.0), "bandwidth": 12.5, "spatial_bandwidth": 40.0, "patch_size": 7, "landmarks": 60}
    preset = Recipe((Step("detail", **values, sampling="uniform"),))
    assert Recipe.from_json(preset.to_json(complete=True), "it") == preset
    assert Recipe.from_json(detail_file('"alpha": [2, 1]'), "it") == Recipe((Step("detail", alpha=(2.0, 1.0)),))


NO_PRESETS = [
    ("alpha = 1", "look.json is not a preset: it is not JSON"),
    ("[1, 2]", "look.json is not a preset: it must hold a list of steps"),
    ('{"bandwidth": 3}', "look.json is not a preset: it must hold a list of steps"),
    ('{"version": 1, "steps": [{"edit": "tone"}]}', "--preset must hold a look or a single detail step, without"),
    ('{"version": 1, "steps": [{"edit": "look", "opacity": 0.5}]}', "switched on and at full opacity, got"),
    ('{"alpha": [2, 1]}', "look.json is not a preset: it must hold a list of steps"),
    (
        detail_file('"alpha": [1]'),
        "alpha of detail, step 1 in look.json must be a list of 2 to 100 numbers from -1000000 to 1000000, got [1]",
    ),
    (
        detail_file('"alpha": []'),
        "alpha of detail, step 1 in look.json must be a list of 2 to 100 numbers from -1000000 to 1000000, got []",
    ),
    (detail_file('"alpha": [1, NaN]'), "alpha of detail, step 1 in look.json must be a list of 2 to 100 numbers"),
    (
        detail_file('"alpha": [1, 1], "bandwidth": 0'),
        "bandwidth of detail, step 1 in look.json must be a positive number of grey levels",
    ),
    (
        detail_file('"alpha": [1, 1], "spatial_bandwidth": "far"'),
        "spatial_bandwidth of detail, step 1 in look.json must be a positive number",
    ),
    (
        detail_file('"alpha": [1, 1], "patch_size": 4'),
        "patch_size of detail, step 1 in look.json must be an odd number from 1 to 99, got 4",
    ),
    (
        detail_file('"alpha": [1, 1], "landmarks": true'),
        "landmarks of detail, step 1 in look.json must be a whole number from 1 to 10000",
    ),
    (
        detail_file('"alpha": [1, 1], "sampling": "best"'),
        'sampling of detail, step 1 in look.json must be "kmeans", "uniform" or "random"',
    ),
    (
        detail_file('"alpha": [1, 1], "colour": 1'),
        "detail, step 1 in look.json must have no entries other than alpha, inside, residual",
    ),
]


def test_a_preset_that_is_none_is_told(
    before: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for text, message in NO_PRESETS:
        monkeypatch.chdir(before.parent)
        Path("look.json").write_text(text)
        assert main(["detail", str(before), "out.png", "--preset", "look.json"]) == 2
        complaint = capsys.readouterr().err
        assert message in complaint
        assert complaint.count("\n") == 1
        assert not Path("out.png").exists()


def test_a_preset_is_written_over(before: Path) -> None:
    preset = before.with_name("look.json")
    preset.write_text("an older one")
    assert fit(before, edit(before), preset) == 0
    assert Recipe.from_json(preset.read_text(), "look.json").steps[0]["alpha"] == pytest.approx(ALPHA, rel=0.02)


def test_a_small_jpeg_of_the_camera_beside_a_tiff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot, camera = tmp_path / "shot.tif", tmp_path / "camera.jpg"
    pixels = rgb("coffee", slice(0, 400, 2), slice(100, 500, 2))
    blurred = torch.nn.functional.avg_pool2d(pixels, 3, 1, 1, count_include_pad=False)
    developed = (pixels + 0.4 * (pixels - blurred)).clamp(0, 1) ** 0.7 * torch.tensor([1.0, 0.95, 0.8]).view(1, 3, 1, 1)
    write_photograph(Photograph(pixels, "uint16"), shot)
    write_photograph(Photograph(resize(developed[..., 4:-4, 6:-6], (144, 141)).clamp(0, 1)), camera)
    assert fit(shot, camera, tmp_path / "look.json") == 0
    told = capsys.readouterr()
    assert "camera.jpg is resized from 141x144 to 188x192, a crop of" in told.err
    before, added = told.out.split("of this, each part adds to those above it\n")
    shares = [re.findall(r"([+-]\d+\.\d) %", line) for line in added.splitlines()]
    total = [float(share) for share in re.findall(r"(\d+\.\d) %", before.splitlines()[-1])]
    for column in (0, 1):
        assert sum(float(row[column]) for row in shares if row) == pytest.approx(total[column], abs=0.5)
    assert total[1] > 90


def test_a_pair_of_one_colour(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain, after = before.with_name("plain.png"), before.with_name("after.png")
    write_photograph(Photograph(torch.full((1, 3, 30, 40), 0.4)), plain)
    write_photograph(Photograph(torch.tensor([0.6, 0.4, 0.2]).view(1, 3, 1, 1).expand(-1, -1, 30, 40)), after)
    assert fit(plain, after, before.with_name("look.json")) == 0
    told = capsys.readouterr()
    assert "plain.png has a single colour; what the look does to others is not known" in told.err
    assert "explained: 100.0 % of the change" in told.out
    assert "-0.0 %" not in told.out


def test_what_cannot_be_fitted_is_told(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small, clipped, preset = (before.with_name(name) for name in ("small.png", "clipped.png", "look.json"))
    pixels = read_photograph(before).pixels
    write_photograph(Photograph(pixels[..., :50, :60].flip(1, 2, 3)), small)
    write_photograph(Photograph((pixels > 0.5).float()), clipped)
    folder = before.with_name("nowhere") / "look.json"
    cases = {
        (before, small, preset): "small.png must have the size of",
        (before, before, preset): "must differ from",
        (before, clipped, preset): "must have pixels that are not clipped",
        (before, before.with_name("none.png"), preset): "none.png does not exist",
        (before, clipped, folder): "does not exist; make it first",
        (before, clipped, before.parent): "is a folder; add a file name to it",
    }
    for arguments, message in cases.items():
        assert fit(*arguments) == 2
        complaint = capsys.readouterr().err
        assert message in complaint
        assert complaint.count("\n") == 1
    assert main(["detail", str(before), str(small), "--preset", str(before.with_name("none.json"))]) == 2
    assert "none.json is neither a file nor one of the presets" in capsys.readouterr().err
    assert not preset.exists()


def test_it_fits_folders_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, edit in (("before", lambda x: x), ("after", lambda x: x**0.6)):
        (tmp_path / folder).mkdir()
        for name, image in (("cat", CAT), ("cup", CUP)):
            write_photograph(Photograph(edit(image)), tmp_path / folder / f"{name}.png")
    look, seen, rest = (tmp_path / name for name in ("look.json", "seen.png", "rest.png"))
    folders = [str(tmp_path / name) for name in ("before", "after")]
    drawn = ["--preview", str(seen), "--map", str(rest)]
    assert main(["fit", *folders, str(look), "--landmarks", "40", *drawn]) == 0
    printed = capsys.readouterr().out
    assert "in other photographs" in printed
    assert float(printed.split("explained: ")[1].split(" %")[0]) > 98
    assert read_photograph(seen).size == (80, 400)
    assert read_photograph(rest).size == (80, 100)
    before, out = tmp_path / "before" / "cup.png", tmp_path / "out.png"
    for command in ("detail", "apply"):
        assert main([command, str(before), str(out), "--preset", str(look)]) == 0
        assert (read_photograph(out).pixels - in_bytes(CUP**0.6)).abs().mean() < 2 / 255
    for sliders in ("1,2", "2.2,2.2,2.2,1"):  # the latter are the default
        assert main(["detail", str(before), str(out), "--preset", str(look), "--alpha", sliders]) == 2
        assert "must not be combined with other options of detail" in capsys.readouterr().err


def test_it_warns_of_a_local_edit_and_fits_regions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, mask, look = (str(tmp_path / name) for name in ("a.png", "b.png", "m.png", "look.json"))
    local = CAT.clone()
    local[..., 32:48, 48:64] = (CAT[..., 32:48, 48:64] + 0.3).clamp(0, 0.99)
    region = torch.zeros_like(CAT[:, :1])
    region[..., 32:48, 48:64] = 1
    for path, image in ((before, CAT), (after, local), (mask, region)):
        write_photograph(Photograph(image), Path(path))
    assert main(["fit", before, after, look, "--landmarks", "40"]) == 0
    told = capsys.readouterr().err
    assert "explains less than 80 %" in told
    assert "around row 32, column 48" in told
    drawn = ["--preview", str(tmp_path / "seen.png")]
    assert main(["fit", before, after, look, "--landmarks", "40", "--mask", mask, *drawn]) == 0
    assert float(capsys.readouterr().out.split("explained: ")[1].split(" %")[0]) > 95
    assert (tmp_path / "look-1.json").exists()
    seen = read_photograph(tmp_path / "seen.png").pixels.split(100, dim=3)  # before, after, the looks, what is left
    assert torch.equal(seen[2][..., :32, :], seen[0][..., :32, :])
    assert explained(seen[0], seen[1], seen[2]) > 0.95


def test_looks_of_regions_are_put_where_their_masks_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, out, rows, look, on_left, on_right, odd = (
        str(tmp_path / f"{name}.png") for name in ("a", "b", "out", "rows", "look", "left", "right", "odd")
    )
    left = (torch.arange(100) < 50).float().expand(1, 1, 80, 100)
    edited = torch.where(left > 0, CAT**0.6, apply_look(CAT, matrix=SEPIA))
    for path, image in ((before, CAT), (after, edited), (on_left, left), (on_right, 1 - left), (odd, left[..., :70])):
        write_photograph(Photograph(image), Path(path))
    look = look.replace(".png", ".json")
    assert main(["fit", before, after, look, "--landmarks", "40", "--mask", on_left, "--mask", on_right]) == 0
    first, second = (look.replace(".json", f"-{i}.json") for i in (1, 2))
    regions = ["--preset", first, "--mask", on_left, "--preset", second, "--mask", on_right]
    assert main(["apply", before, out, *regions]) == 0
    pixels, target = read_photograph(Path(out)).pixels, read_photograph(Path(after)).pixels
    assert explained(CAT, target, pixels) > 0.98
    assert main(["apply", before, rows, *regions, "--memory", "0.001"]) == 0
    assert (read_photograph(Path(rows)).pixels - pixels).abs().max() <= 1.01 / 255
    assert main(["apply", before, out, "--preset", first, "--mask", on_left]) == 0
    pixels = read_photograph(Path(out)).pixels
    assert torch.equal(pixels[..., 50:], read_photograph(Path(before)).pixels[..., 50:])
    assert main(["apply", before, out, "--preset", first, "--preset", second, "--mask", on_left]) == 2
    assert "--mask must come once for each --preset, got 1 for 2" in capsys.readouterr().err
    for memory in ([], ["--memory", "0.001"]):
        assert main(["apply", before, out, "--preset", first, "--mask", odd, *memory]) == 2
        assert "must have the size of" in capsys.readouterr().err


def test_folders_of_masks_belong_to_folders_of_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left = (torch.arange(100) < 50).float().expand(1, 1, 80, 100)
    folders = {name: tmp_path / name for name in ("before", "after", "left", "right")}
    for name, image in (("cat", CAT), ("cup", CUP)):
        edited = torch.where(left > 0, image**0.6, apply_look(image, matrix=SEPIA))
        for folder, picture in zip(folders.values(), (image, edited, left, 1 - left), strict=True):
            folder.mkdir(exist_ok=True)
            write_photograph(Photograph(picture), folder / f"{name}.png")
    before, after, first, other = map(str, folders.values())
    look, out = tmp_path / "look.json", tmp_path / "out.png"
    assert main(["fit", before, after, str(look), "--landmarks", "40", "--mask", first, "--mask", other]) == 0
    assert "in other photographs" in capsys.readouterr().out
    for number, part, curve in ((1, slice(50), True), (2, slice(50, 100), False)):
        preset = str(tmp_path / f"look-{number}.json")
        assert main(["apply", f"{before}/cup.png", str(out), "--preset", preset]) == 0
        wanted = in_bytes(CUP**0.6 if curve else apply_look(CUP, matrix=SEPIA))[..., part]
        assert explained(CUP[..., part], wanted, read_photograph(out).pixels[..., part]) > 0.98
    (folders["right"] / "cat.png").unlink()
    for masks, message in {
        (first, other): "right must hold a mask for every photograph, got none for cat.png; add one",
        (f"{first}/cat.png",): "--mask must name folders of masks, as BEFORE and AFTER are folders, got",
    }.items():
        named = [word for mask in masks for word in ("--mask", mask)]
        assert main(["fit", before, after, str(look), *named]) == 2
        complaint = capsys.readouterr().err
        assert message in complaint
        assert complaint.count("\n") == 1
    assert main(["fit", f"{before}/cat.png", f"{after}/cat.png", str(look), "--mask", first]) == 2
    assert "--mask must name pictures, as BEFORE and AFTER are, got" in capsys.readouterr().err


def test_pairs_that_do_not_belong_together_are_refused_without_notes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = tmp_path / "before", tmp_path / "after"
    for folder, names in ((before, "13"), (after, "1")):
        folder.mkdir()
        for name in names:
            write_photograph(Photograph(CAT if folder == before else CUP), folder / f"{name}.png")
    sentence = refusal(capsys, "fit", before, after, tmp_path / "look.json")
    assert sentence.startswith(f"{after}/1.png must be an edit of {before}/1.png")


def test_a_frame_is_told_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, look = (str(tmp_path / name) for name in ("a.png", "b.png", "look.json"))
    framed = torch.full_like(CAT, 0.9)
    framed[..., 8:-8, 8:-8] = (CAT**0.6)[..., 8:-8, 8:-8]
    write_photograph(Photograph(CAT), Path(before))
    write_photograph(Photograph(framed), Path(after))
    assert main(["fit", before, after, look, "--landmarks", "40"]) == 0
    printed = capsys.readouterr()
    assert "b.png has a frame of one colour, which is left out" in printed.err
    assert float(printed.out.split("explained: ")[1].split(" %")[0]) > 98


def test_it_refuses_what_does_not_belong_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, look = (tmp_path / name for name in ("a.png", "b.png", "look.json"))
    write_photograph(Photograph(CAT), before)
    write_photograph(Photograph(CUP.flip(2, 3)), after)
    assert main(["fit", str(before), str(after), str(look), "--landmarks", "40"]) == 2
    assert "check that they show the same picture" in capsys.readouterr().err
    assert main(["fit", str(tmp_path), str(after), str(look)]) == 2
    assert "two photographs or two folders" in capsys.readouterr().err
    assert not look.exists()


def test_large_photographs_are_judged_at_the_viewing_size(
    before: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "nlfilter_torch.photo.cli.commands.step_of", lambda *_: Step("look", viewing_size=0.003, landmarks=40)
    )
    height, width = CAT.shape[-2:]
    write_photograph(Photograph(CAT**1.3), before.with_name("after.png"))
    seen = before.with_name("seen.png")
    assert fit(before, before.with_name("after.png"), before.with_name("look.json"), "--preview", seen) == 0
    assert 2500 < read_photograph(seen).pixels[0, 0].numel() / 4 < 3500 < height * width
    assert float(re.search(r"explained: ([\d.]+) %", capsys.readouterr().out)[1]) > 99  # type: ignore[index]


def test_pairs_in_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, look = tmp_path / "before", tmp_path / "after", tmp_path / "look.json"
    for folder in (before, after):
        (folder / "d.png").mkdir(parents=True)
        (folder / "._cat.png").write_bytes(b"of macOS")
    for folder, name, image in (
        (before, "cat.png", CAT),
        (after, "cat.png", CAT**0.6),
        (after, "cat.tif", 1 - CAT),
        (before, "cup.png", CUP),
        (after, "cup.tif", CUP**0.6),
    ):
        write_photograph(Photograph(image), folder / name)
    assert fit(before, after, look) == 0
    assert float(capsys.readouterr().out.split("explained: ")[1].split(" %")[0]) > 98
    look.unlink()

    def refused() -> str:
        assert fit(before, after, look) == 2
        assert not look.exists()
        return capsys.readouterr().err

    write_photograph(Photograph(CUP), after / "cup.jpg")
    sentence = "must hold one photograph of the name of cup.png, got cup.jpg and cup.tif; remove all but one"
    assert f"{after} {sentence}" in refused()
    (after / "cup.jpg").unlink()
    write_photograph(Photograph(CUP), before / "cup.jpg")
    assert f"{before} must hold one photograph for {after / 'cup.tif'}, got cup.jpg and cup.png; remove" in refused()
