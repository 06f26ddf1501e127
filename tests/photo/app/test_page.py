"""The editor's page without a browser, and its files: the functions of its script, and that a wheel holds them."""

import asyncio
import shutil
import subprocess
import zipfile
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
from nicegui import Client, background_tasks, ui

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.dialogs import Question
from nlfilter_torch.photo.app.library import Library
from nlfilter_torch.photo.app.page import EDITORS, Editor
from nlfilter_torch.photo.app.server import SCRIPTS, STATIC, STATIC_ADDRESS
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.tools import Proportions
from nlfilter_torch.photo.declared.development import WHOLE_CROP, Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.pages import ROOT
from tests.problems import cat

OLDEST_NODE = 20


class Page:
    """A page, whose work in the background runs when :meth:`finish` is called."""

    def __init__(self, client: Client, library: Library, works: list[Awaitable[None]]) -> None:
        self.client, self.works = client, works
        self.editor = Editor(library)
        self.editor.build(())

    def finish(self) -> None:
        while self.works:
            asyncio.run(self.works.pop(0))  # type: ignore[arg-type]

    def open(self, path: Path) -> None:
        self.editor._begin(path, "")
        self.finish()

    @property
    def session(self) -> Session:
        """The session of the photograph that is shown."""
        assert self.editor.session is not None
        return self.editor.session

    def errors(self) -> list[str]:
        return [element.message for element in self.client.elements.values() if isinstance(element, ui.notification)]

    def picture(self, kind: str) -> bytes | None:
        return self.editor.picture(kind, "")


@pytest.fixture
def works(monkeypatch: pytest.MonkeyPatch) -> list[Awaitable[None]]:
    works: list[Awaitable[None]] = []
    monkeypatch.setattr(background_tasks, "create", lambda work, **options: works.append(work))
    monkeypatch.setattr("nlfilter_torch.photo.app.closeup.QUIET", 0.0)
    return works


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    write_photograph(Photograph(cat()), tmp_path / "cat.png")
    return tmp_path / "cat.png"


@pytest.fixture
def page(client: Client, photo: Path, works: list[Awaitable[None]]) -> Iterator[Page]:
    yield Page(client, Library(photo.parent), works)
    EDITORS.clear()


@pytest.fixture
def opened(page: Page, photo: Path) -> Page:
    page.open(photo)
    return page


ALPHA = (3.0, 1.0, 1.0, 1.0)


def test_a_photograph_is_opened(opened: Page, photo: Path, scripts: list[str]) -> None:
    editor = opened.editor
    assert editor._title.text == "cat.png"
    assert editor.thumbnail("warm").endswith("/look-warm?1")
    assert editor.session is not None
    assert opened.picture("before") == opened.picture("after") == drawing.picture(cat())
    assert not opened.picture("mask")
    assert opened.picture("piece-1") is None
    assert "closeup.open(150, 100, '/picture/" in "".join(scripts)
    assert "page.watchConnection(); page.takeDropped(" in "".join(scripts)
    assert scripts[-1] != "page.isUnsaved = true"
    editor._begin(photo, "")  # a browser that reconnects keeps its edit
    assert opened.works == []


def test_the_frame_of_the_crop_ends_with_its_tab_and_its_photograph(opened: Page, photo: Path) -> None:
    editor = opened.editor
    tool = editor._canvas._crop_tool._tool

    def crop() -> None:
        editor.toggle_crop()
        opened.finish()
        assert editor.is_cropping
        assert tool.visible
        assert editor._canvas.pick is None

    ends: list[Callable[[], None]] = [
        editor.toggle_crop,
        editor.toggle_pick,
        lambda: editor._switch("tone"),
        lambda: editor._tasks.start(editor._open(lambda: editor._photographs.open(photo))),
    ]
    for end in ends:
        crop()
        end()
        opened.finish()
        assert not editor.is_cropping
        assert not tool.visible
    assert editor._canvas.pick is None


def test_proportions_of_the_crop_and_looks_of_what_it_leaves(opened: Page, scripts: list[str]) -> None:
    editor, before = opened.editor, (opened.editor.thumbnail("warm"), opened.picture("look-warm"))
    editor.hold("1:1")
    opened.finish()
    assert editor.is_cropping
    assert opened.session.size == (100, 100)
    assert any("cropper.show(" in script and script.endswith(f", {100 / 150})") for script in scripts)
    after = editor.thumbnail("warm"), opened.picture("look-warm")
    assert [old != new for old, new in zip(before, after, strict=True)] == [True, True]
    editor.hold("3:2")  # of the whole photograph, and not of the square
    opened.finish()
    assert opened.session.size == (100, 150)
    editor._reset()
    opened.finish()
    assert editor.proportions.name == "Free"
    scripts.clear()
    editor.hold("Free")
    opened.finish()
    assert any(script.endswith(", null)") for script in scripts)


def test_images_of_the_command_are_in_the_strip_in_their_order(page: Page, photo: Path) -> None:
    other = photo.with_name("second.png")
    write_photograph(Photograph(cat().flip(3)), other)
    editor = Editor(page.editor._photographs)
    editor.build((other, photo))
    editor._begin(other, "")
    page.finish()
    assert [shot.name for shot in editor._shots.values()] == ["second.png", "cat.png"]
    assert editor.session is not None
    assert editor.session.name == "second.png"


def test_proportions_end_with_a_crop_that_lacks_them(opened: Page) -> None:
    editor, session = opened.editor, opened.session
    other = Editor(editor._photographs)  # a second tab, which shows the same photograph
    other.build(())
    other.session = session
    changes: list[Callable[[], object]] = [
        lambda: (editor._undo(), editor._undo()),
        lambda: session.load(Recipe()),
        lambda: other.develop({"crop": (0.0, 0.0, 1.0, 0.5)}, True),
    ]
    for change in changes:
        editor.hold("1:1")
        editor._crop((0.0, 0.0, 0.3, 0.3))
        editor.develop({"exposure": 1.0}, True)
        editor._undo()
        editor._crop((0.0, 0.0, 0.6, 0.3))
        editor._undo()  # to a crop that has them, too
        assert (editor.proportions.name, other.proportions.name) == ("1:1", "Free")
        change()
        editor._changed()
        assert editor.proportions.name == "Free"
        editor._reset()
    opened.finish()


def test_proportions_are_cut_from_the_crop_of_before_when_straightened(opened: Page) -> None:
    editor, session = opened.editor, opened.session
    editor.hold("1:1")
    editor.develop({"straighten": 3.0}, True)
    width = session.recipe.develop.frame((100, 150)).size[1]
    assert editor.proportions.name == "1:1"
    editor.hold("3:2")
    assert session.recipe.develop.frame((100, 150)).size[1] > width + 20  # of the whole photograph
    opened.finish()


def test_a_crop_that_is_refused_changes_nothing(opened: Page, scripts: list[str]) -> None:
    editor, session = opened.editor, opened.session
    session.load(Recipe((), Development(straighten=45.0)))
    editor.proportions = Proportions(cut=WHOLE_CROP, base=(0.0, 0.0, 0.1, 0.1))
    editor.hold("1:1")
    assert "crop must have its middle within the photograph" in opened.errors()[-1]
    assert editor.proportions.name == "Free"
    assert not editor.is_cropping
    editor.hold("1:1")  # now of the crop as it is
    opened.finish()
    before = session.recipe
    scripts.clear()
    editor._crop((0.0, 0.0, 1.0, 1.1))
    opened.finish()
    assert "crop must be the left, top, right and bottom edge" in opened.errors()[-1]
    assert session.recipe == before
    assert any("cropper.show(" in script for script in scripts)  # the frame of before


def test_looks_that_failed_are_drawn_with_the_next_picture(opened: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    editor, before = opened.editor, opened.editor.thumbnail("warm")
    with monkeypatch.context() as failing:
        failing.setattr("nlfilter_torch.photo.app.page.thumbnails", lambda _: ["is no dictionary"][1])
        editor.develop({"crop": (0.0, 0.0, 0.5, 0.5)}, True)
        with pytest.raises(IndexError):
            opened.finish()
    assert editor.thumbnail("warm") == before
    editor.change("detail", {"alpha": ALPHA}, True)
    opened.finish()
    assert editor.thumbnail("warm") != before


def test_a_file_that_cannot_be_opened(page: Page, photo: Path) -> None:
    photo.write_text("dear diary")
    page.open(photo)
    assert len(page.errors()) == 1
    assert "is not a PNG" in page.errors()[0]
    assert page.editor.session is None


def test_an_address_that_is_gone(page: Page) -> None:
    page.editor._begin(None, "gone.png")
    page.finish()
    assert page.errors() == ["open the photograph again: this page lost it, but its edit is kept"]


def test_a_change_is_shown_while_the_pointer_moves_and_can_then_be_undone(opened: Page, scripts: list[str]) -> None:
    editor, session = opened.editor, opened.session
    editor.change("detail", {"alpha": ALPHA}, False)
    opened.finish()
    edited = opened.picture("after")
    assert edited == drawing.picture(session.render())
    assert edited != opened.picture("before")
    assert not editor._undo_button.enabled
    editor.change("detail", {"alpha": ALPHA}, True)
    opened.finish()
    assert editor._undo_button.enabled
    assert editor._reset_button.enabled
    assert scripts[-1] == "page.isUnsaved = true"
    editor._undo()
    opened.finish()
    assert session.recipe == Recipe()
    assert opened.picture("after") == opened.picture("before")
    editor._redo()
    opened.finish()
    assert opened.picture("after") == edited
    editor._reset()
    opened.finish()
    assert session.recipe == Recipe()
    assert editor._undo_button.enabled


def test_a_sketch_follows_a_slider_and_is_completed_at_rest(
    page: Page, photo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.app.developed.DRAFT_PIXELS", 5000)
    monkeypatch.setattr("nlfilter_torch.photo.app.page.REST", 0.0)
    page.open(photo)
    page.editor.change("tone", {"contrast": 1.3}, False)
    page.finish()
    draft = page.session.draft(0)
    assert draft is not None
    assert page.picture("after") == drawing.picture(draft)
    page.editor.change("tone", {"contrast": 1.3}, True)
    asyncio.run(page.works.pop(0))  # type: ignore[arg-type]
    assert page.picture("after") == drawing.picture(draft)
    page.finish()
    assert page.picture("after") == drawing.picture(page.session.render()) != drawing.picture(draft)


def test_strokes_are_cleared(opened: Page) -> None:
    session = opened.session
    opened.editor._switch("detail")
    for kind in ("pointerdown", "pointerup"):
        opened.editor._canvas._pointer(kind, 20, 20)
    opened.finish()
    assert len(session.recipe.current("detail").strokes) == 1
    assert opened.picture("mask")
    opened.editor.clear("detail")
    opened.finish()
    assert session.recipe.current("detail").strokes == ()
    assert not opened.picture("mask")


def test_colorize_asks_before_it_replaces_colours(opened: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    editor, session = opened.editor, opened.session
    answers = [False, True]

    async def answer(question: Question) -> bool:
        return answers.pop(0)

    monkeypatch.setattr(Question, "answer", answer)
    editor._canvas.switch("colorize")
    for strokes in (0, 1, 2):  # asked twice: then it has a stroke
        for kind in ("pointerdown", "pointerup"):
            editor._canvas._pointer(kind, 20, 20)
        opened.finish()
        assert len(session.recipe.current("colorize").strokes) == strokes
    assert answers == []


def test_a_change_before_a_photograph_is_not_kept(page: Page) -> None:
    page.editor.change("tone", {"contrast": 1.3}, True)
    page.editor.clear("detail")
    assert page.editor.recipe() == Recipe()
    for ask in (page.editor._ask_photo_name, page.editor._ask_edit_name):
        asyncio.run(ask())
        assert page.errors()[-1] == "open a photograph first; there is nothing to save"


def test_tabs_that_show_a_photograph_share_its_edit(opened: Page, photo: Path) -> None:
    library = opened.editor._photographs
    with Client(ui.page("/")) as client:
        other = Page(client, library, opened.works)
        other.open(photo)
        assert other.editor.session is opened.session
        opened.editor.change("detail", {"alpha": ALPHA}, True)
        opened.finish()
        assert other.picture("after") == opened.picture("after") != other.picture("before")
    other.editor._leave()
    assert list(EDITORS.values()) == [opened.editor]
    client.delete()


def test_saving(opened: Page, photo: Path) -> None:
    editor = opened.editor
    editor.change("detail", {"alpha": ALPHA}, True)
    opened.finish()
    asyncio.run(editor._save(Progress(), opened.session.save, "out.png"))
    assert photo.with_name("out.png").is_file()
    asyncio.run(editor._save(Progress(), opened.session.save_preset, "edit.json"))
    assert Recipe.from_json(photo.with_name("edit.json").read_bytes(), "") == opened.session.recipe
    assert not opened.session.unsaved


def node() -> str | None:
    """The program that runs JavaScript, if there is one that is not too old."""
    program = shutil.which("node")
    if program is None:
        return None
    version = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout
    return program if int(version.removeprefix("v").partition(".")[0]) >= OLDEST_NODE else None


def test_functions_of_the_script() -> None:
    program = node()
    if program is None:
        pytest.skip(f"no node here; install it, in version {OLDEST_NODE} or later")
    files = sorted((Path(__file__).parent / "js").glob("*.test.js"))
    done = subprocess.run([program, "--test", *files], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "# fail 0" in done.stdout
    assert len(files) == 4


def test_scripts_of_the_page_are_files() -> None:
    assert SCRIPTS.count("<script") == 3
    for name in ("page.js", "closeup.js", "crop.js"):
        assert f'src="{STATIC_ADDRESS}/{name}"' in SCRIPTS
        assert (STATIC / name).is_file()


def test_a_wheel_holds_the_files_of_the_page(tmp_path: Path) -> None:
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    builder.get_build_hooks = lambda _: {}  # that of hatch_build.py would compile the kernels
    (wheel,) = builder.build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    files = {path.relative_to(ROOT).as_posix() for path in STATIC.iterdir()}
    assert {Path(name).suffix for name in files} == {".js", ".css"}
    assert files <= names
    assert not any(name.endswith("package.json") for name in names)
