"""The counterparts of the paper's figures are drawn, with captions and numbers, on small photographs."""

import json
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import edits
from benchmarks.harness import Figure
from docs.figures import FIGURES
from docs.figures.__main__ import main

PAPER = {"1", "3", "6", "7", "8", "9", "10", "11", "12", "13", "14", "15", "16", "17", "18", "20", "table-1"}


@pytest.mark.slow
def test_every_figure_is_drawn_with_its_caption_and_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert FIGURES.keys() == PAPER
    main(["--quick", "--out", str(tmp_path / "new" / "figures")])
    told = capsys.readouterr().out
    kept = json.loads((tmp_path / "new" / "figures" / "figures.json").read_text(encoding="utf-8"))
    assert kept.keys() == PAPER
    for entry in kept.values():
        assert entry["caption"] in told
        assert entry["numbers"]
        with Image.open(tmp_path / "new" / "figures" / entry["picture"]) as picture:
            assert min(picture.size) > 200


def test_only_some_and_no_unknown_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--quick", "--only", "6", "--out", str(tmp_path)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figure-6.png", "figures.json"]
    with pytest.raises(SystemExit):
        main(["--only", "2,6", "--out", str(tmp_path)])
    assert "got 2" in capsys.readouterr().err


@pytest.mark.slow
def test_every_promise_of_masks_and_edits_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert edits.main(["--out", str(tmp_path / "edits.json")]) == 0, capsys.readouterr().out
    kept = json.loads((tmp_path / "edits.json").read_text(encoding="utf-8"))
    assert len(kept) == 16
    assert all(promise["holds"] for promise in kept)
    assert "FALLS SHORT" not in capsys.readouterr().out


def test_a_promise_that_is_broken_is_told() -> None:
    assert not Figure("", 2.0, 1.0).holds
    assert not Figure("", 1.0, 2.0, at_most=False).holds
    assert not Figure("", float("nan"), 1.0).holds
