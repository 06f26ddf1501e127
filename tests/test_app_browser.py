"""The editor in a real browser: tests perform the actions of a user."""

import http.client
import io
import signal
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urljoin

import pytest
import skimage.data
import torch
from PIL import Image
from playwright.sync_api import Browser, expect

from nlfilter_torch.cli import main
from nlfilter_torch.edits.presets import find_recipe
from nlfilter_torch.edits.recipe import Recipe
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.io.photographs import Photograph, read_photograph, write_photograph
from tests.browser import CHROMIUM, SCREENS, Editor, Tab, chromium

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here; install it: apt-get install chromium")


def cat() -> torch.Tensor:
    """(1, 3, 100, 150) in [0, 1]."""
    return torch.from_numpy(skimage.data.chelsea()[::3, :450:3].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def editor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Editor]:
    editor = Editor(tmp_path_factory.mktemp("editor"))
    yield editor
    editor.stop()
    assert editor.log.read_text() == ""  # no traceback, no warning


@pytest.fixture
def folder(editor: Editor) -> Iterator[Path]:
    """The folder that the editor saves to, with a photograph in it."""
    folder = editor.log.parent
    write_photograph(Photograph(cat()), folder / "cat.png")
    yield folder
    for file in folder.iterdir():
        if file != editor.log:
            file.unlink()


@pytest.fixture
def tab(browser: Browser, editor: Editor, folder: Path) -> Iterator[Tab]:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    tab = Tab(page)
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith(editor.url) else troubles.append(request.url))
    page.goto(editor.url)
    yield tab
    page.close()
    # Every script, font and picture is served by the editor itself.
    assert [trouble for trouble in troubles if not trouble.startswith(("data:", "blob:", "ws://127.0.0.1:"))] == []


@pytest.fixture
def opened(tab: Tab, folder: Path) -> Tab:
    tab.open(folder / "cat.png")
    expect(tab.page.get_by_text("150×100 pixels")).to_be_visible()
    tab.wait_for_picture()
    expect(tab.page.locator(".response circle")).not_to_have_count(0)
    return tab


def shown(tab: Tab) -> torch.Tensor:
    """The picture in the page, (1, 3, H, W)."""
    answer = tab.page.request.get(urljoin(tab.page.url, tab.source()))
    picture = Image.open(io.BytesIO(answer.body()))
    return (
        torch.frombuffer(bytearray(picture.tobytes()), dtype=torch.uint8)
        .view(1, picture.height, picture.width, 3)
        .permute(0, 3, 1, 2)
        / 255
    )


def difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """Root mean square difference in grey levels of 255."""
    return float((a.clamp(0, 1) - b.clamp(0, 1)).square().mean().sqrt()) * 255


def test_photograph_is_shown(opened: Tab, folder: Path) -> None:
    assert difference(shown(opened), cat()) < 4  # JPEG
    expect(opened.page.get_by_text("cat.png")).to_be_visible()
    assert sorted(file.name for file in folder.iterdir()) == ["cat.png", "log.txt"]  # nothing is left behind


def test_picture_follows_a_slider_and_undo(opened: Tab) -> None:
    before = opened.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.8, release=False)
    opened.wait_for_picture(before)  # while the button is held
    opened.page.mouse.up()
    expect(opened.page.get_by_text("4.00 ×")).to_be_visible()
    wanted = Recipe().apply(cat())
    opened.page.wait_for_timeout(300)
    assert difference(shown(opened), wanted) > 8
    before = opened.source()
    opened.page.keyboard.press("Control+z")
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("4.00 ×")).not_to_be_visible()
    assert difference(shown(opened), wanted) < 4
    before = opened.source()
    opened.page.get_by_role("button", name="Redo").click()
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("4.00 ×")).to_be_visible()


def test_stroke_shows_a_mask_and_sliders_of_the_region(opened: Tab) -> None:
    """The mask is shown for a second, or while its box is checked, but never while a slider moves."""
    page = opened.page
    expect(opened.mask).not_to_be_visible()
    opened.paint((0.2, 0.9), (0.3, 0.9), release=False)
    expect(page.locator("path.stroke")).to_have_count(1)  # while the button is held
    page.mouse.up()
    expect(opened.mask).to_be_visible()
    expect(page.get_by_text("In the region")).to_be_visible()
    expect(opened.mask).not_to_be_visible()  # after a second, by itself
    page.get_by_role("checkbox", name="Mask").click()
    expect(opened.mask).to_be_visible()
    before = opened.source()
    opened.drag(opened.slider("Texture in the region"), 0.2, 0.9, release=False)
    opened.wait_for_picture(before)
    expect(opened.mask).not_to_be_visible()  # not while a slider moves
    page.mouse.up()
    expect(opened.mask).to_be_visible()
    page.get_by_role("checkbox", name="Mask").click()
    expect(opened.mask).not_to_be_visible()
    page.get_by_role("button", name="Clear strokes").first.click()
    expect(page.get_by_text("In the region")).not_to_be_visible()
    expect(page.locator("path.stroke")).to_have_count(0)


def test_saved_files_are_what_the_library_and_the_command_line_make(opened: Tab, folder: Path) -> None:
    """Sliders, a region and a new colour; then the same edit from its file."""
    page = opened.page
    opened.drag(opened.slider("Fine detail"), 0.2, 0.6)
    opened.paint((0.2, 0.9), (0.3, 0.9))
    expect(opened.mask).to_be_visible()
    before = opened.source()
    page.get_by_role("tab", name="Recolor").click()
    page.get_by_role("button", name="#8a46c8").first.click()
    opened.paint((0.37, 0.35), (0.4, 0.37))
    opened.wait_for_picture(before)
    opened.save("Save photo", "out.png")
    opened.save("Save edit", "edit.json")

    recipe = find_recipe(str(folder / "edit.json"))
    assert recipe.last("detail")["inside"] == (1.0, 3.0, 1.0, 1.0)
    assert recipe.last("recolor").strokes[0].paint == "#8a46c8"
    saved = read_photograph(folder / "out.png").pixels
    assert (saved - recipe.apply(cat()).clamp(0, 1)).abs().max() <= 1 / 255
    assert main(["apply", str(folder / "cat.png"), str(folder / "cli.png"), "--preset", str(folder / "edit.json")]) == 0
    assert (saved - read_photograph(folder / "cli.png").pixels).abs().max() <= 1 / 255
    assert difference(shown(opened), saved) < 5

    page.get_by_role("button", name="Reset").click()
    expect(opened.mask).not_to_be_visible()
    before = opened.source()
    opened.load_edit(folder / "edit.json")
    opened.wait_for_picture(before)
    page.get_by_role("tab", name="Detail").click()
    expect(opened.mask).to_be_visible()
    page.wait_for_timeout(500)
    assert difference(shown(opened), saved) < 5

    page.get_by_role("button", name="Save photo").click()
    page.get_by_label("Name").fill("out.png")
    page.get_by_role("button", name="Save", exact=True).click()
    expect(page.get_by_text("A file of that name is there already.")).to_be_visible()
    page.get_by_role("button", name="Replace").click()
    expect(page.get_by_text("out.png").first).to_be_visible()


@pytest.mark.parametrize(("step", "control"), [("Defocus", "Blur"), ("Abstract", "Flatten"), ("Colorize", "Fill")])
def test_other_steps_change_the_picture(opened: Tab, step: str, control: str) -> None:
    page = opened.page
    page.get_by_role("tab", name=step).click()
    before = opened.source()
    if step != "Abstract":
        opened.paint((0.4, 0.4), (0.45, 0.4))
        opened.wait_for_picture(before)
        before = opened.source()
    opened.drag(opened.slider(control), 0.5, 0.7, release=False)
    opened.wait_for_picture(before)  # while the button is held
    page.mouse.up()
    page.wait_for_timeout(500)
    assert difference(shown(opened), cat()) > 5


def test_preset_and_response(opened: Tab) -> None:
    curve = opened.page.locator(".response polyline")
    flat = curve.get_attribute("points")
    before = opened.source()
    opened.choose("Start from", "crisp")
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("2.20 ×").first).to_be_visible()
    assert curve.get_attribute("points") != flat
    expect(opened.page.get_by_text("crisp:").first).to_be_visible()  # the name stays
    before = opened.source()
    opened.drag(opened.slider("Bandwidth"), 0.3, 0.6)
    opened.wait_for_picture(before)
    expect(opened.page.get_by_text("Started from crisp, then changed")).to_be_visible()


def test_histogram_and_clipping(opened: Tab) -> None:
    page = opened.page
    expect(page.get_by_role("img", name="histogram")).to_be_visible()
    clipped = page.get_by_alt_text("clipped")
    expect(clipped).not_to_be_visible()
    page.get_by_role("checkbox", name="Clipped").click()
    expect(clipped).to_be_visible()
    page.get_by_role("tab", name="Tone").click()
    before = opened.source()
    opened.drag(opened.slider("Contrast"), 0.5, 1.0)
    opened.wait_for_picture(before)
    expect(page.get_by_text("Clipped: ")).to_be_visible()


def test_errors_leave_when_something_succeeds(opened: Tab, folder: Path) -> None:
    (folder / "notes.png").write_text("dear diary")
    opened.open(folder / "notes.png")
    error = opened.page.get_by_text("notes.png is not a PNG")
    expect(error).to_be_visible()
    before = opened.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.8)
    opened.wait_for_picture(before)
    expect(error).not_to_be_visible(timeout=5000)  # before it would disappear by itself


def test_keyboard_focus_can_be_seen(opened: Tab) -> None:
    page = opened.page
    frame = "() => getComputedStyle(document.activeElement).boxShadow"
    page.keyboard.press("Tab")
    for _ in range(3):
        assert "rgb(255, 213, 74)" in page.evaluate(frame), page.evaluate("() => document.activeElement.outerHTML")
        page.keyboard.press("Tab")
    opened.slider("Texture").focus()
    page.keyboard.press("ArrowRight")
    assert "rgb(255, 213, 74)" in page.evaluate(frame)


@pytest.mark.parametrize(("width", "height"), SCREENS)
def test_layout_on_every_screen(browser: Browser, editor: Editor, folder: Path, width: int, height: int) -> None:
    """Nothing is outside the screen, and on a phone a finger can draw and save."""
    phone = width < 500
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=phone, is_mobile=phone)
    tab = Tab(context.new_page())
    page = tab.page
    page.goto(editor.url)
    tab.open(folder / "cat.png")
    tab.wait_for_picture()
    expect(page.locator(".response circle")).not_to_have_count(0)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    photo, save = tab.photo.bounding_box(), page.get_by_role("button", name="Save photo").bounding_box()
    panel = page.locator(".panel").bounding_box()
    assert photo is not None
    assert save is not None
    assert panel is not None
    assert save["x"] + save["width"] <= width
    assert save["y"] >= 0
    assert (36 if width < 1000 else 30) <= save["height"] <= 52  # large enough for a finger, and not cut off
    assert photo["width"] * photo["height"] > 0.15 * width * height
    assert panel["y"] >= photo["y"] + photo["height"] or panel["x"] >= photo["x"] + photo["width"]  # beside it
    if not phone:
        context.close()
        return
    touch = context.new_cdp_session(page)
    for kind, share in (("touchStart", 0.2), ("touchMove", 0.25), ("touchMove", 0.3), ("touchEnd", None)):
        place = (
            []
            if share is None
            else [{"x": photo["x"] + share * photo["width"], "y": photo["y"] + 0.9 * photo["height"]}]
        )
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": place})
    expect(page.locator("path.stroke")).to_have_count(1)
    expect(page.get_by_text("In the region")).to_be_visible()
    page.get_by_role("button", name="Show or hide the controls").tap()
    expect(page.get_by_text("In the region")).not_to_be_in_viewport()
    page.get_by_role("button", name="Save photo").tap()
    page.get_by_label("Name").fill("phone.png")
    page.get_by_role("button", name="Save", exact=True).tap()
    expect(page.get_by_text("Saved ").and_(page.get_by_text("phone.png"))).to_be_visible()
    assert (folder / "phone.png").exists()
    context.close()


def test_wipe_shows_what_was_before(opened: Tab) -> None:
    opened.drag(opened.slider("Before and after"), 0.0, 0.5)
    clip = opened.page.get_by_alt_text("before").evaluate("element => getComputedStyle(element).clipPath")
    assert clip.startswith(("inset(0px calc(50%", "inset(0px 50%")), clip
    expect(opened.page.get_by_text("before", exact=True)).to_be_visible()


def test_a_stroke_before_a_photograph(tab: Tab) -> None:
    tab.page.get_by_text("Open a photograph to begin").click()
    expect(tab.page.get_by_text("open a photograph first; there is nothing to paint on")).to_be_visible()
    tab.page.get_by_role("button", name="Save photo").click()
    expect(tab.page.get_by_text("open a photograph first; there is nothing to save")).to_be_visible()


def test_files_that_cannot_be_used(opened: Tab, folder: Path) -> None:
    page = opened.page
    (folder / "notes.png").write_text("dear diary")
    opened.open(folder / "notes.png")
    expect(page.get_by_text("notes.png is not a PNG, JPEG, TIFF, WebP or AVIF image")).to_be_visible()

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    # 1,000 megapixels in a few bytes: refused by its header, on any machine with less than 700 GB of memory.
    header = struct.pack(">IIBBBBB", 20_000, 50_000, 8, 0, 0, 0, 0)
    (folder / "huge.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b"")
    )
    opened.open(folder / "huge.png")
    expect(
        page.get_by_text("huge.png is too large").or_(page.get_by_text("huge.png has 20000x50000 pixels"))
    ).to_be_visible()

    (folder / "edit.json").write_text('{"detail": {"sharpness": 11}}')
    opened.load_edit(folder / "edit.json")
    expect(page.get_by_text("detail in edit.json must have no entries other than")).to_be_visible()

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
    other = Tab(browser.new_page(viewport={"width": 1280, "height": 900}))
    other.page.goto(editor.url)
    other.open(folder / "coffee.png")
    other.wait_for_picture()
    before, others = opened.source(), other.source()
    opened.drag(opened.slider("Texture"), 0.2, 0.6, release=False)
    other.drag(other.slider("Texture"), 0.2, 0.9)
    opened.page.mouse.up()
    opened.wait_for_picture(before)
    other.wait_for_picture(others)
    opened.save("Save photo", "a.png")
    other.save("Save photo", "b.png")
    other.page.close()
    for name, alpha, image in (("a.png", 3.0, cat()), ("b.png", 4.5, coffee)):
        wanted = Recipe().apply(image)
        recipe = find_recipe("crisp")
        recipe = Recipe((Step("detail", alpha=(alpha, 1.0, 1.0, 1.0)),))
        assert (read_photograph(folder / name).pixels - recipe.apply(image).clamp(0, 1)).abs().max() <= 1 / 255
        assert difference(recipe.apply(image), wanted) > 5


def test_foreign_names_of_this_machine_are_refused(editor: Editor) -> None:
    host, port = editor.url.removeprefix("http://").rstrip("/").split(":")
    for name, status in ((f"{host}:{port}", 200), ("evil.example", 400)):
        connection = http.client.HTTPConnection(host, int(port))
        connection.request("GET", "/", headers={"Host": name})
        assert connection.getresponse().status == status
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
    other = Tab(browser.new_page(viewport={"width": 1280, "height": 900}))
    other.page.goto(editor.url)
    other.open(folder / "cat.png")
    other.wait_for_picture()
    other.page.get_by_role("button", name="Save photo").click()
    expect(other.page.get_by_label("Name")).to_be_visible()
    other.page.close()
    opened.page.wait_for_timeout(5000)  # after three seconds a page is considered closed
    assert editor.log.read_text() == ""


def test_pictures_are_for_those_who_know_their_address(opened: Tab, editor: Editor) -> None:
    request = opened.page.request
    assert request.get(editor.url.rstrip("/") + opened.source()).status == 200
    for address in ("picture/another/after", opened.source().removeprefix("/").replace("after", "mask")):
        assert request.get(editor.url + address).status == 404


def test_stopped_in_the_midst_of_saving(browser: Browser, tmp_path: Path) -> None:
    """The process is killed: the old file is unchanged, and the page reports that the editor has ended."""
    large = torch.nn.functional.interpolate(cat(), size=(600, 900), mode="bicubic").clamp(0, 1)
    write_photograph(Photograph(large), tmp_path / "large.png")
    (tmp_path / "out.png").write_bytes(b"what was there")
    editor = Editor(tmp_path, "large.png")
    try:
        tab = Tab(browser.new_page(viewport={"width": 1280, "height": 900}))
        tab.page.goto(editor.url)
        tab.wait_for_picture()
        expect(tab.page.locator(".response circle")).not_to_have_count(0)
        tab.drag(tab.slider("Texture"), 0.2, 0.8)
        tab.page.get_by_role("button", name="Save photo").click()
        tab.page.get_by_label("Name").fill("out.png")
        tab.page.get_by_role("button", name="Save", exact=True).click()
        tab.page.get_by_role("button", name="Replace").click()
        expect(tab.page.get_by_text("Saving…")).to_be_visible()
        editor.process.send_signal(signal.SIGKILL)
        editor.process.wait(30)
        assert (tmp_path / "out.png").read_bytes() == b"what was there"
        expect(tab.page.get_by_text("Connection lost")).to_be_visible(timeout=60_000)
        tab.page.close()
    finally:
        editor.stop()
