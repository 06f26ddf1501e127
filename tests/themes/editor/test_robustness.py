"""The editor in a real browser: unusable files, several tabs, other sites, and a process that is killed."""

import http.client
import resource
import signal
import struct
import sys
import time
import zlib
from pathlib import Path

import pytest
import skimage.data
import torch
from playwright.sync_api import Browser, expect

from nlfilter_torch.photo.declared.presets import Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.browser import TIMEOUT, Editor, Tab, difference, dropped, running
from tests.problems import cat

WATCHED = """window.seen = { welcome: false, signs: new Set() };
const look = () => { const shown = (place) => document.querySelector(place)?.checkVisibility();
  if (shown('.welcome')) seen.welcome = true;
  if (shown('.working')) seen.signs.add(document.querySelector('.working').innerText.trim());
  requestAnimationFrame(look); }; requestAnimationFrame(look)"""


def test_a_page_that_opens_a_photograph_says_so_and_asks_for_none(browser: Browser, tmp_path: Path) -> None:
    write_photograph(Photograph(cat(4)), tmp_path / "cat.png")
    (tmp_path / "cat.png.edit.json").write_text(Recipe((Step("tone", contrast=1.3),)).to_json())
    with running(tmp_path, "cat.png") as editor:
        tab = Tab(browser.new_page(viewport={"width": 1280, "height": 900}))
        tab.page.add_init_script(WATCHED)
        tab.page.goto(editor.with_token())
        expect(tab.page.locator(".panel[inert]")).to_have_count(0)
        tab.wait_for_picture()
        welcome, signs = tab.page.evaluate("[seen.welcome, [...seen.signs]]")
        assert not welcome
        assert "Opening\u2026" in signs
        assert "Applying the edit\u2026" in signs
        assert not tab.photo.evaluate("image => image.parentElement.classList.contains('waiting')")
        tab.page.close()


def test_errors_leave_when_something_succeeds(opened: Tab, folder: Path) -> None:
    (folder / "notes.png").write_text("dear diary")
    opened.open(folder / "notes.png")
    error = opened.page.get_by_text("notes.png is not a PNG")
    expect(error).to_be_visible()
    before = opened.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.8)
    opened.wait_for_picture(before)
    expect(error).not_to_be_visible(timeout=5000)  # before it would disappear by itself


def test_before_a_photograph_one_is_chosen_or_dropped(tab: Tab, folder: Path) -> None:
    page = tab.page
    page.get_by_role("button", name="Save photo").click()
    expect(page.get_by_text("open a photograph first; there is nothing to save")).to_be_visible()
    with page.expect_file_chooser():
        page.get_by_role("button", name="Open a photograph to begin").click()
    content = (folder / "cat.png").read_bytes()
    assert not dropped(page, {"notes.txt": b"", "dropped.png": content})  # the page is not left for it
    expect(page.locator(".title")).to_have_text("dropped.png")
    tab.open_details()
    before = tab.source()
    recipe = Recipe((Step("detail", alpha=(3.0, 1.0, 1.0, 1.0)),)).to_json().encode()
    assert not dropped(page, {"edit.json": recipe, "b.json": recipe})
    expect(page.get_by_text("Only one edit is loaded at a time: edit.json.")).to_be_visible()
    tab.wait_for_picture(before)
    assert not dropped(page, {"notes.txt": b"dear diary"})
    expect(page.get_by_text("notes.txt must be a PNG, JPEG, TIFF, WebP, AVIF or HEIC file")).to_be_visible()
    assert dropped(page, {})  # text, which fields take
    page.get_by_role("button", name="Save photo").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    assert not dropped(page, {"edit.json": b""})
    expect(page.get_by_text("edit.json is not opened while a dialog is; close it")).to_be_visible()


def test_a_slider_before_a_photograph(tab: Tab, folder: Path) -> None:
    tab.page.get_by_role("tab", name="Detail").click()
    tab.drag(tab.slider("Texture"), 0.2, 0.8)
    expect(tab.page.get_by_text("1.00 ×")).to_have_count(4)
    tab.open(folder / "cat.png")
    tab.wait_until_ready()
    expect(tab.page.get_by_role("button", name="Undo")).to_be_disabled()


def test_files_that_cannot_be_used(opened: Tab, folder: Path) -> None:
    page = opened.page
    (folder / "notes.png").write_text("dear diary")
    opened.open(folder / "notes.png")
    expect(page.get_by_text("notes.png is not a PNG, JPEG, TIFF, WebP or AVIF image")).to_be_visible()

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    # 1,000 megapixels in a few bytes: refused by its header.
    header = struct.pack(">IIBBBBB", 20_000, 50_000, 8, 0, 0, 0, 0)
    (folder / "huge.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")
    )
    opened.open(folder / "huge.png")
    expect(
        page.get_by_text("huge.png is too large").or_(page.get_by_text("huge.png has 20000x50000 pixels"))
    ).to_be_visible()

    (folder / "edit.json").write_text('{"version": 1, "steps": [{"edit": "detail", "sharpness": 11}]}')
    opened.load_edit(folder / "edit.json")
    expect(page.get_by_text("detail, step 1 in edit.json must have no entries other than")).to_be_visible()

    page.get_by_role("button", name="Save photo").click()
    for name, sentence in (("../out.png", "the name must be one of a file"), ("out.gif", "out.gif must end in .png")):
        page.get_by_label("Name").fill(name)
        page.get_by_role("button", name="Save", exact=True).click()
        expect(page.get_by_text(sentence)).to_be_visible()
    page.get_by_role("button", name="Cancel").click()

    assert "Traceback" not in page.content()
    before = opened.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.8)  # and the editor still works
    opened.wait_for_picture(before)


def test_recolouring_a_grey_photograph_says_what_to_do(tab: Tab, folder: Path) -> None:
    write_photograph(Photograph(cat()[:, :1]), folder / "grey.png")
    tab.open(folder / "grey.png")
    tab.wait_for_picture()
    tab.page.get_by_role("tab", name="Recolor").click()
    tab.paint((0.4, 0.4), (0.5, 0.4))
    expect(tab.page.get_by_text("recolor needs a colour photograph, got a grey one; use colorize")).to_be_visible()


def test_two_tabs_edit_two_photographs(opened: Tab, browser: Browser, editor: Editor, folder: Path) -> None:
    coffee = torch.from_numpy(skimage.data.coffee()[::4, ::4].copy()).permute(2, 0, 1)[None].float() / 255
    write_photograph(Photograph(coffee), folder / "coffee.png")
    other = Tab.at(browser, editor.with_token())
    other.open(folder / "coffee.png")
    other.wait_for_picture()
    before, others = opened.source(), other.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.6, release=False)
    other.open_details()
    other.drag(other.slider("Texture"), 0.2, 0.9)
    opened.page.mouse.up()
    opened.wait_for_picture(before)
    other.wait_for_picture(others)
    opened.save("Save photo", "a.png")
    other.save("Save photo", "b.png")
    other.close()
    for name, alpha, image in (("a.png", 3.0, cat()), ("b.png", 4.5, coffee)):
        wanted = apply_recipe(Recipe(), image)
        recipe = find_recipe("crisp")
        recipe = Recipe((Step("detail", alpha=(alpha, 1.0, 1.0, 1.0)),))
        assert (read_photograph(folder / name).pixels - apply_recipe(recipe, image).clamp(0, 1)).abs().max() <= 1 / 255
        assert difference(apply_recipe(recipe, image), wanted) > 5


def test_foreign_names_of_this_machine_are_refused(editor: Editor) -> None:
    host, port = editor.url.removeprefix("http://").rstrip("/").split(":")
    known = {"Cookie": f"nlfilter-torch-{port}={editor.token}"}
    for name, cookies, status in (
        (f"{host}:{port}", known, 200),
        (f"{host}:{port}", {}, 403),
        ("evil.example", known, 400),
    ):
        connection = http.client.HTTPConnection(host, int(port))
        connection.request("GET", "/", headers={"Host": name} | cookies)
        answer = connection.getresponse()
        assert answer.status == status
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        connection.close()


def test_other_sites_reach_nothing(tab: Tab, editor: Editor, browser: Browser) -> None:
    """A page of another site opens a websocket and sends a file to the editor: both are refused."""
    address = editor.url.removeprefix("http://").rstrip("/")
    opens = """address => new Promise(done => {
        const socket = new WebSocket(`ws://${address}/_nicegui_ws/socket.io/?EIO=4&transport=websocket`);
        socket.onopen = () => done("open"); socket.onerror = () => done("refused"); })"""
    assert tab.page.evaluate(opens, address) == "open"
    foreign = browser.new_page()
    foreign.route("http://evil.example/", lambda route: route.fulfill(body="<p>hello</p>", content_type="text/html"))
    foreign.goto("http://evil.example/")
    assert foreign.evaluate(opens, address) == "refused"
    foreign.close()
    host, port = address.split(":")
    for headers, status in (
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": f"http://{address}", "Content-Length": "5000000000"}, 413),
    ):
        connection = http.client.HTTPConnection(host, int(port))
        connection.request("POST", "/", headers=headers)
        assert connection.getresponse().status == status
        connection.close()


def test_a_tab_that_is_closed_with_a_dialog_open(opened: Tab, browser: Browser, editor: Editor, folder: Path) -> None:
    """The log stays empty, which the fixture of the editor checks."""
    other = Tab.at(browser, editor.with_token())
    other.open(folder / "cat.png")
    other.wait_for_picture()
    other.page.get_by_role("button", name="Save photo").click()
    expect(other.page.get_by_label("Name")).to_be_visible()
    address = other.source()
    other.close()
    # The page is considered closed after a while; then a request is answered behind all that its end has logged.
    opened.wait_until(lambda: float(opened.answer(address).status), least=404, most=404)
    assert opened.answer(address).status == 404
    assert editor.log.read_text() == ""


def test_pictures_are_for_those_who_know_their_address(opened: Tab, editor: Editor) -> None:
    request = opened.page.request
    assert request.get(editor.url.rstrip("/") + opened.source()).status == 200
    for address in ("picture/another/after", opened.source().removeprefix("/").replace("after", "mask")):
        assert request.get(editor.url + address).status == 404


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the files of another process")
def test_a_full_disk(opened: Tab, editor: Editor, folder: Path) -> None:
    """No scribble is lost: what was kept stays, the page has the rest, and keeps it as soon as there is room."""
    page, kept = opened.page, folder / "cat.png.edit.json"
    strokes, room = page.locator("path.stroke"), resource.prlimit(editor.process.pid, resource.RLIMIT_FSIZE)
    opened.paint((0.2, 0.9), (0.3, 0.9))
    expect(page.get_by_text("In the region")).to_be_visible()
    before = kept.read_bytes()
    resource.prlimit(editor.process.pid, resource.RLIMIT_FSIZE, (0, room[1]))  # no file may have more than 0 bytes
    opened.paint((0.6, 0.2), (0.7, 0.2))
    expect(page.get_by_text("the edit cannot be kept")).to_be_visible()
    page.get_by_role("button", name="Save photo").click()
    page.get_by_label("Name").fill("full.png")
    page.get_by_role("button", name="Save", exact=True).click()
    expect(page.get_by_text("full.png cannot be written: File too large; free some space there")).to_be_visible()
    assert kept.read_bytes() == before
    assert {path.name for path in folder.iterdir()} == {"cat.png", kept.name, "log.txt"}
    page.reload()
    expect(strokes).to_have_count(2)
    resource.prlimit(editor.process.pid, resource.RLIMIT_FSIZE, room)
    opened.wait_until_ready()
    opened.paint((0.6, 0.6), (0.7, 0.6))
    expect(strokes).to_have_count(3)
    opened.save("Save photo", "full.png")
    assert len(Recipe.from_json(kept.read_text(), "").current("detail").strokes) == 3


def wait_for_part(folder: Path, name: str) -> None:
    """Wait until a hidden file, later renamed to ``name``, is being written."""
    deadline = time.monotonic() + TIMEOUT / 1000
    while not any(folder.glob(f".{name}.*.part")):
        assert time.monotonic() < deadline, sorted(folder.iterdir())
        time.sleep(0.001)


def test_stopped_in_the_midst_of_saving(browser: Browser, tmp_path: Path) -> None:
    """The process is killed: the old file is unchanged, and after a new start the page has the edit and saves it."""
    write_photograph(Photograph(cat()), tmp_path / "cat.png")
    (tmp_path / "out.png").write_bytes(b"what was there")
    # Saving stops where the complete file is about to replace the old one.
    stopping = "import shutil, time\nshutil.copymode = lambda _, part: time.sleep(3600 * ('out.png' in str(part)))"
    editor = Editor(tmp_path, "cat.png", before=stopping)
    try:
        tab = Tab.at(browser, editor.with_token())
        tab.open_details()
        tab.paint((0.2, 0.9), (0.3, 0.9))
        expect(tab.page.get_by_text("In the region")).to_be_visible()
        tab.drag(tab.slider("Texture in the region"), 0.2, 0.8)
        expect(tab.page.get_by_text("4.00 ×")).to_be_visible()
        tab.page.get_by_role("button", name="Save photo").click()
        tab.page.get_by_label("Name").fill("out.png")
        tab.page.get_by_role("button", name="Save", exact=True).click()
        tab.page.get_by_role("button", name="Replace").click()
        wait_for_part(tmp_path, "out.png")
        editor.process.send_signal(signal.SIGKILL)
        editor.process.wait()
        assert (tmp_path / "out.png").read_bytes() == b"what was there"
        editor.stop()
        editor = Editor(tmp_path, "cat.png", "--port", editor.url.rstrip("/").rsplit(":", 1)[1])
        address = tab.page.url
        tab.close()
        tab = Tab.at(browser, editor.with_token(address))
        expect(tab.page.locator("path.stroke")).to_have_count(1)
        expect(tab.page.get_by_text("4.00 ×")).to_be_visible()
        tab.save("Save photo", "again.png")
        tab.close()
        assert {path.name for path in tmp_path.iterdir()} >= {"again.png", "cat.png.edit.json"}
    finally:
        editor.stop()
