"""Files that the editor opens and saves: they equal those of the command line, and refusals change nothing."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

from nlfilter_torch.__main__ import main
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.app.developed import Developed
from nlfilter_torch.photo.app.session import Session, reduced_size
from nlfilter_torch.photo.declared.presets import find_recipe
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import HiddenPixels, Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from tests.problems import LINE, cat, difference


@pytest.fixture
def photo(session: Session) -> Path:
    """The file that is open."""
    return session.folder / "cat.png"


def test_saving_is_what_the_command_line_does(session: Session, photo: Path) -> None:
    """All steps together, to 1/255."""
    session.set("detail", alpha=(1.5, 1.5, 1.5, 1.0))
    session.add_stroke("detail", LINE, 0.03, "in")
    session.set("detail", inside=(0.2, 0.5, 1.0, 1.0))
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    session.add_stroke("defocus", LINE, 0.05, "in")
    session.set("abstract", edges=0.5)
    saved = read_photograph(session.save("out.png")).pixels
    edit = session.save_preset("edit.json")
    assert find_recipe(str(edit)) == session.recipe
    assert main(["apply", str(photo), str(photo.with_name("cli.png")), "--preset", str(edit)]) == 0
    assert difference(saved, read_photograph(photo.with_name("cli.png")).pixels) <= 1
    assert difference(saved, apply_recipe(session.recipe, cat())) <= 1


def test_an_object_is_cut_out_of_the_edited_photograph(session: Session, photo: Path) -> None:
    with pytest.raises(ValueError, match="an object of defocus must be marked to be cut out, got none"):
        session.cut_out("cut.png", "defocus")
    session.set("tone", contrast=1.3)
    session.add_box("defocus", (30, 20), (120, 80), "box")
    saved, cut = (read_photograph(path) for path in (session.save("out.png"), session.cut_out("cut.png", "defocus")))
    assert cut.alpha is not None
    assert cut.alpha[..., :20, :].max() == 0
    solid = (cut.alpha > 0.99).expand(-1, 3, -1, -1)
    assert solid.any()
    assert (cut.pixels - saved.pixels)[solid].abs().max() <= 3 / 255
    with pytest.raises(ValueError, match=r"cut\.jpg cannot hold this picture: JPEG has no alpha channel"):
        session.check_cutout("cut.jpg")
    with pytest.raises(ValueError, match="the name must not be that of the photograph"):
        session.check_cutout("cat.png")


def test_a_size_and_a_quality(session: Session, photo: Path) -> None:
    session.set("tone", contrast=1.1)
    large = session.save("a.jpg", quality=100).stat().st_size
    small = session.save("b.jpg", quality=60, side=75)
    assert read_photograph(small).size == (50, 75)
    assert small.stat().st_size < large / 4
    whole = read_photograph(session.save("c.png", side=4000))
    assert whole.size == (100, 150)
    half = read_photograph(session.save("d.png", side=75))
    assert difference(half.pixels, resize(whole.pixels, (50, 75)).clamp(0, 1)) <= 1.5
    alpha = whole.pixels[:, :1].clone()
    alpha[..., :40] = 0
    write_photograph(replace(whole, alpha=alpha), photo.with_name("alpha.png"))
    session = Session(session.folder, photo.with_name("alpha.png"))
    halves = read_photograph(session.save("e.png", side=75))
    assert halves.alpha is not None
    assert halves.alpha.shape == (1, 1, 50, 75)
    hidden = HiddenPixels(np.zeros((100, 150), bool), np.zeros((0, 3), np.uint8), nodata=0)
    with pytest.raises(ValueError, match="pixels without data must be saved in its own size"):
        reduced_size(replace(whole, hidden=hidden), 75)


def test_sliders_alone_are_a_preset_of_detail(session: Session, photo: Path) -> None:
    session.set("detail", alpha=(3.0, 3.0, 4.0, 1.05), bandwidth=12.0)
    saved, edit = session.save("out.png"), session.save_preset("edit.json")
    assert main(["detail", str(photo), str(photo.with_name("cli.png")), "--preset", str(edit)]) == 0
    assert difference(read_photograph(saved).pixels, read_photograph(photo.with_name("cli.png")).pixels) <= 1


def test_grey_photographs_become_coloured_files(tmp_path: Path) -> None:
    write_photograph(Photograph(reduce_channels(cat(), "luminance"), "uint16"), tmp_path / "grey.png")
    session = Session(tmp_path, tmp_path / "grey.png")
    session.add_stroke("colorize", LINE, 0.03, "#2040e0")
    assert session.render().shape == (1, 3, 100, 150)
    saved = read_photograph(session.save("colour.png"))
    assert saved.pixels.shape == (1, 3, 100, 150)
    assert saved.depth == "uint16"


NAMES = [
    ("a.jpg", Photograph(cat(9)), "a-edited.jpg"),
    ("a.PNG", Photograph(cat(9)), "a-edited.png"),
    ("a.jpg", Photograph(cat(9), "uint16"), "a-edited.png"),
    ("a.jpg", Photograph(cat(9), alpha=cat(9)[:, :1]), "a-edited.png"),
    ("a", Photograph(cat(9), "float32"), "a-edited.tif"),
]


def test_names_to_save_under(session: Session) -> None:
    for name, photograph, wanted in NAMES:
        session.name = name
        session.original = session.developed = Developed.of(photograph, name, 81)
        assert session.suggested_name() == wanted
        session.save(wanted)  # which supports this depth


def test_files_that_are_no_images(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.write_bytes(b"dear diary")
    with pytest.raises(ValueError, match=r"^notes\.txt is not a PNG, JPEG, TIFF, WebP or AVIF image"):
        Session(tmp_path, copy, "notes.txt")
    copy.write_bytes(b"")
    with pytest.raises(ValueError, match=r"^empty\.png is empty"):
        Session(tmp_path, copy, "empty.png")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Session(tmp_path, tmp_path / "none.png")


def test_a_photograph_too_large_for_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = type("Memory", (), {"available": 3 * 10**9})
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    Image.new("L", (10_000, 10_000)).save(tmp_path / "copy", format="PNG")
    with pytest.raises(
        MemoryError, match=r"^huge\.png has 10000x10000 pixels and needs about 4.0 GB of memory, but only 3.0 GB is"
    ):
        Session(tmp_path, tmp_path / "copy", "huge.png")


def test_an_edit_too_large_for_the_machine(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    free = type("Memory", (), {"available": 10**6})
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    session.add_stroke("defocus", LINE, 0.05, "in")
    with pytest.raises(MemoryError, match=r"cat\.png has 150x100 pixels and needs"):
        session.save("out.png")
    assert not (session.folder / "out.png").exists()


def test_names_that_lead_out_of_the_folder(session: Session) -> None:
    for name in ["", "..", "a/b.png", "/tmp/b.png", ".hidden.png", "a\0.png", "../b.png"]:
        for save in (session.save, session.save_preset):
            with pytest.raises(ValueError, match="the name must be one of a file"):
                save(name)


def test_saving_what_cannot_be_saved(session: Session, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in \.png, \.jpg"):
        session.save("out.gif")
    with pytest.raises(ValueError, match=r"must end in \.json"):
        session.save_preset("out.png")
    session.folder = tmp_path / "gone"
    with pytest.raises(ValueError, match="does not exist"):
        session.save("out.png")


def test_an_interrupted_save_leaves_the_old_file(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    target = session.save("out.png")
    before = target.read_bytes()
    session.set("abstract", power=0.5)

    def break_off(stream: io.BytesIO, *_: object) -> None:
        stream.write(before[:100])
        raise OSError("no space left on device")

    monkeypatch.setattr("nlfilter_torch.photo.files.png.write_png", break_off)
    with pytest.raises(OSError, match="no space left"):
        session.save("out.png")
    assert target.read_bytes() == before
    assert sorted(file.name for file in session.folder.iterdir()) == ["cat.png", "out.png"]
