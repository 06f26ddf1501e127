"""The comparison of denoisers: its scores, pictures and tables, and the public sets with their published figures."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.denoising import methods, sets
from benchmarks.denoising.__main__ import main
from benchmarks.denoising.cases import HELD_OUT, Case, decibels, scenes, table, with_noise
from benchmarks.free_photographs import photographs
from benchmarks.training.patterns import APART, TRAINED
from docs import published_denoisers as published
from docs.denoising_tables import MARKERS, markers_of, tables_of
from docs.denoising_tables import main as write_tables
from docs.pages import between


def test_scores_are_decibels_of_the_squared_error(capsys: pytest.CaptureFixture[str]) -> None:
    clean = torch.full((1, 1, 16, 16), 0.5)
    case = Case("grey", clean, clean + 0.1, 0.1)
    rows = table({"noisy": lambda case: case.noisy, "half": lambda case: case.noisy - 0.05}, [case])
    assert rows["noisy"]["grey"].psnr == pytest.approx(20, abs=1e-4)
    assert rows["half"]["grey"].psnr == pytest.approx(26.0206, abs=1e-3)
    assert capsys.readouterr().out.splitlines()[1].split()[:3] == ["noisy", "20.00", "20.00"]
    assert decibels(0.01) == pytest.approx(20)


def test_scenes_are_grey_or_in_colour_and_have_noise_of_their_own() -> None:
    grey, coloured = (scenes(None, kind, quick=False) for kind in ("grey", "colour"))
    assert tuple(grey) == HELD_OUT
    assert "camera" not in coloured
    assert all(picture.shape[1] == 1 for picture in grey.values())
    first, second = (with_noise(grey["camera"], 0.1, number) for number in (0, 1))
    assert not torch.equal(first, second)
    assert float((first - grey["camera"]).std()) == pytest.approx(0.1, rel=0.01)


def test_the_benchmark_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    main(["--quick", "--noise", "25", "--methods", "noisy", "ours", "--wrong", "--out", str(out)])
    figures = json.loads(out.read_text())
    assert set(figures) == {"grey, 25", "colour, 25"}
    assert figures["grey, 25"]["ours"]["camera"]["psnr"] > figures["grey, 25"]["noisy"]["camera"]["psnr"]
    printed = capsys.readouterr().out
    assert "estimated noise" in printed
    main(["--quick", "--noise", "25", "--kinds", "grey", "--methods", "rule", "--out", str(out)])
    assert set(json.loads(out.read_text())["grey, 25"]) == {"noisy", "ours", "rule"}

    page = tmp_path / "page.md"
    page.write_text("above\n{}\n{}\nbelow".format(*MARKERS))
    write_tables([str(out), "--docs", str(page)])
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("above", "below")
    row = next(line for line in lines if line.startswith("| ours"))
    mean = sum(result["psnr"] for result in figures["grey, 25"]["ours"].values()) / 2
    assert f"{mean:.2f}" in row


def test_a_file_without_the_markers_of_the_tables_is_refused(tmp_path: Path) -> None:
    page, figures = tmp_path / "page.md", tmp_path / "figures.json"
    page.write_text("no markers")
    figures.write_text('{"grey, 25": {"ours": {"camera": {"psnr": 30.0, "ssim": 0.9, "seconds": 1.0}}}}')
    with pytest.raises(ValueError, match="the file must hold the lines '<!-- denoising"):
        write_tables([str(figures), "--docs", str(page)])


DOCS = Path(__file__).parents[2] / "docs"


def folder_of(path: Path, count: int, *, coloured: bool = True, side: int = 24) -> Path:
    """A folder of so many small pictures of random pixels."""
    path.mkdir()
    generator = np.random.default_rng(0)
    for number in range(count):
        pixels = generator.integers(0, 256, (side, side + number % 2, 3), dtype=np.uint8)
        Image.fromarray(pixels if coloured else pixels[..., 0]).save(path / f"{number:03}.png")
    return path


@pytest.mark.parametrize(
    ("folder", "count", "coloured", "name", "kinds"),
    [
        ("pictures", 12, False, "Set12", ("grey",)),
        ("pictures", 68, False, "BSD68", ("grey",)),
        ("pictures", 68, True, "CBSD68", ("colour",)),
        ("pictures", 24, True, "Kodak24", ("grey", "colour")),
        ("pictures", 24, False, "Kodak24", ("grey",)),
        ("pictures", 18, True, "McMaster", ("grey", "colour")),
        ("pictures", 100, True, "Urban100", ("grey", "colour")),
        ("Urban100", 2, True, "Urban100", ("grey", "colour")),
        ("CBSD68-test", 3, True, "CBSD68", ("colour",)),
        ("Kodak 24", 1, True, "Kodak24", ("grey", "colour")),
    ],
)
def test_a_set_is_recognised_by_its_folder_or_number_of_pictures(
    tmp_path: Path, folder: str, count: int, coloured: bool, name: str, kinds: tuple[str, ...]
) -> None:
    pictures = sets.recognise(folder_of(tmp_path / folder, count, coloured=coloured, side=4))
    assert (pictures.name, pictures.kinds, len(pictures.paths)) == (name, kinds, count)
    assert [name for name, _ in pictures.pictures(kinds[0])] == [f"{number:03}" for number in range(count)]


def test_a_set_may_be_named_and_its_kind_chosen(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "any", 3)
    assert sets.recognise(folder, "Set12").name == "Set12"
    assert sets.recognise(folder, "Kodak24", ["grey"]).kinds == ("grey",)
    assert sets.recognise(folder, "BSD68", ["grey"]).name == "BSD68"  # its pictures in colour, measured in grey


@pytest.mark.parametrize(
    ("count", "coloured", "arguments", "message"),
    [
        (3, True, [], "holds 3 pictures, as none of them; name it by --name"),
        (0, True, [], "but .* has none"),
        (3, False, ["--name", "Kodak24", "--kinds", "colour"], "--kinds must be grey for .*, got colour"),
    ],
)
def test_other_folders_are_refused(
    tmp_path: Path, count: int, coloured: bool, arguments: list[str], message: str
) -> None:
    folder = folder_of(tmp_path / "any", count, coloured=coloured, side=4)
    with pytest.raises(SystemExit, match=message):
        main(["--set", str(folder), *arguments])


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="--set must be a folder of pictures"):
        main(["--set", str(tmp_path / "nowhere")])


def test_grey_pictures_are_luminance_in_8_bits(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], dtype=np.uint8)).save(path)
    grey, coloured = sets.read(path, "grey"), sets.read(path, "colour")
    assert torch.allclose(255 * grey, torch.tensor([76.0, 150.0, 29.0]), atol=1e-4)
    assert torch.equal(coloured[0, :, 0], torch.eye(3))


def test_a_set_is_measured_by_the_protocol_and_shown_beside_published_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = folder_of(tmp_path / "kodak24", 2), tmp_path / "kodak24.json"
    arguments = ["--set", str(folder), "--noise", "25", "--kinds", "colour", "--out", str(out)]
    main([*arguments, "--methods", "noisy", "ours"])
    assert capsys.readouterr().out.startswith("colour, noise 25: PSNR of noisy ")
    write_tables([str(out)])
    printed = capsys.readouterr().out
    assert "| FFDNet | 32.13 |" in printed
    assert "Means over 2 pictures." in printed
    assert published.SOURCES["Zhang 2018"] in " ".join(printed.split())
    content = json.loads(out.read_text())
    assert content["set"] == "Kodak24"
    rows = content["results"]["colour, 25"]
    (name, clean), *_ = sets.recognise(folder).pictures("colour")
    noisy = with_noise(clean, 25 / 255, 0)
    assert rows["noisy"][name]["psnr"] == pytest.approx(decibels(float((noisy - clean).square().mean())), abs=1e-3)

    main([*arguments, "--methods", "scikit-image NLM"])  # adds to the file
    assert set(json.loads(out.read_text())["results"]["colour, 25"]) == {"noisy", "ours", "scikit-image NLM"}
    with pytest.raises(SystemExit, match=r"--out must have results of McMaster, but .* has others"):
        main([*arguments, "--methods", "noisy", "--name", "McMaster"])


def test_results_are_clipped_before_they_are_judged() -> None:
    clean = torch.ones(1, 1, 4, 4)
    case = Case("white", clean, clean + 0.5, 0.5)
    assert torch.equal(sets.clipped(lambda case: case.noisy)(case), clean)


def test_published_figures_are_of_known_sets_and_sources_and_fall_with_the_noise() -> None:
    assert {name for name, _ in published.PUBLISHED} == set(sets.NAMES)
    for entries in published.PUBLISHED.values():
        for entry in entries:
            assert entry.source in published.SOURCES
            known = [value for value in entry.psnr if value is not None]
            assert known == sorted(known, reverse=True)
            assert all(25 < value < 36 for value in known)
    assert published.published("Kodak24", "grey") == ()


def test_patterns_that_repeat_were_kept_aside(tmp_path: Path) -> None:
    grey, coloured = (list(sets.patterns(kind, None, quick=True)) for kind in ("grey", "colour"))
    assert [name.split()[0] for name, _ in grey] == list(APART)
    assert not set(APART) & set(TRAINED)
    assert all(picture.shape[1:] == (1, 48, 48) for _, picture in grey)
    assert all(0 <= float(picture.min()) <= float(picture.max()) <= 1 for _, picture in coloured)
    (tmp_path / "reporting").mkdir()
    wanted = [photograph for photograph in photographs() if photograph.set == "reporting" and photograph.repeated]
    for photograph in wanted:
        Image.new("RGB", (300, 270), "gray").save(tmp_path / "reporting" / f"{photograph.name}.png")
    added = list(sets.patterns("colour", tmp_path, quick=True))[len(coloured) :]
    assert [name for name, _ in added] == [f"photographs {photograph.name}" for photograph in wanted]
    assert all(picture.shape == (1, 3, 256, 256) for _, picture in added)
    with pytest.raises(SystemExit, match="has none of them; prepare them by"):
        main(["--patterns", "--quick", "--methods", "noisy", "--pictures", str(tmp_path / "reporting")])


def test_the_lead_on_patterns_is_printed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "patterns.json"
    main(["--patterns", "--quick", "--kinds", "grey", "--methods", "noisy", "ours", "--out", str(out)])
    capsys.readouterr()
    write_tables([str(out)])
    printed = capsys.readouterr().out
    rows = json.loads(out.read_text())["results"]["grey, 25"]
    means = {method: sum(values["psnr"] for values in row.values()) / len(APART) for method, row in rows.items()}
    line = next(line for line in printed.splitlines() if line.startswith("| noisy"))
    assert line.split("|")[-3:-1] == [f" {means['noisy']:.2f} ", f" {means['ours'] - means['noisy']:+.2f} "]


def test_bm3d_is_left_out_where_it_is_not_installed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("benchmarks.denoising.methods.find_spec", lambda name: None)
    assert list(methods.available(["noisy", "BM3D"])) == ["noisy"]
    assert "bm3d is not installed" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["kodak24", "patterns"])
def test_the_tables_of_the_docs_are_those_of_their_file(name: str) -> None:
    content = json.loads((DOCS / f"{name}.json").read_text())
    page = (DOCS / "training.md").read_text()
    assert between(page, tables_of(content), *markers_of(content)) == page
