"""The benchmark of files: what differs, is refused and is lost is counted."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from benchmarks import files
from benchmarks.files import agree, main
from tests.files import cat


def test_generated_files_are_read_or_refused_for_a_known_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "in"), "--generate"]) == 0
    told = capsys.readouterr().out
    assert "unexplained, different or lost" in told
    assert "as tifffile reads them" in told
    assert "is stored in SEPARATED colours" in told


def test_what_is_wrong_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal that is not known, pixels that differ, and a tag that is lost."""
    folder, known = tmp_path / "in", tmp_path / "known.json"
    folder.mkdir()
    known.write_text(json.dumps({"is empty": "No picture."}))
    (folder / "empty.png").touch()
    (folder / "text.png").write_text("no picture")
    tifffile.imwrite(folder / "tag.tif", cat(20, 30), extratags=[(65000, 3, 1, 7, True)], metadata=None)
    Image.fromarray(cat(20, 30)).save(folder / "other.png")
    monkeypatch.setitem(files.READERS, "Pillow", lambda path: 255 - cat(20, 30) if path.suffix == ".png" else None)
    monkeypatch.setattr(files, "tags_of", lambda path: {"65000": 7} if path.name == "tag.tif" else {})
    assert main([str(folder), "--known", str(known)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert sum("refused without a known reason" in line for line in lines) == 1
    assert sum(line.endswith("other.png: pixels differ from those of Pillow") for line in lines) == 1
    assert sum(line.endswith("tag.tif: lost without a note: 65000") for line in lines) == 1
    assert lines[-1].split() == ["3", "unexplained,", "different", "or", "lost"]


def test_readers_agree_up_to_rounding_where_pixels_are_opaque() -> None:
    picture = cat(20, 30)
    assert agree(picture, picture)
    assert agree(picture.astype(np.uint16) * 257, picture)
    assert not agree(picture, picture[:10])
    assert not agree(picture, np.roll(picture, 1, axis=1))
    clear = np.concatenate([picture, np.zeros_like(picture[..., :1])], axis=2)
    assert agree(np.concatenate([255 - picture, clear[..., 3:]], axis=2), clear)
