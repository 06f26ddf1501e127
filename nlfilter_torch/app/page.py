"""The editor's page: the canvas, the controls beside it, and the reactions to them."""

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import background_tasks, events, ui

from nlfilter_torch.app import drawing
from nlfilter_torch.app.canvas import Canvas
from nlfilter_torch.app.panel import Brush, Panel
from nlfilter_torch.app.session import Session
from nlfilter_torch.app.style import CSS

EXPECTED = (ValueError, OSError, MemoryError)  # for unusable files and values; the message says why
PATIENCE = 0.3  # seconds until the page shows that it is working
INSIDE, OUTSIDE = "#4ade80", "#60a5fa"  # colours of the sliders' response in the region, and elsewhere
EDITORS: dict[str, "Editor"] = {}  # open pages by the token in the addresses of their pictures


class Editor:
    """One tab of the browser and its session.

    Args:
        session: of editing.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self._token = secrets.token_urlsafe(16)
        self._wanted: list[str | None] = []  # at most one: the last step of the picture to draw next
        self._drawing = False

    def build(self, image: Path | None) -> None:
        """Lay the page out, and open a photograph if there is one."""
        EDITORS[self._token] = self
        self._client = ui.context.client
        self._client.on_delete(lambda: EDITORS.pop(self._token, None))
        ui.add_css(CSS)
        self._build_header()
        brush = Brush()
        with ui.element("div").classes("editor"):
            with ui.element("div").classes("viewer"):
                self._canvas = Canvas(self.session, brush, self._token, self._changed, self._show_error)
            with ui.column().classes("panel"):
                self._panel = Panel(self.session, brush, self._change, self._canvas.switch)
        ui.keyboard(on_key=self._key)
        if image is not None:
            self._client.on_connect(lambda: self._begin(image))

    @property
    def pictures(self) -> dict[str, bytes]:
        """Files of the pictures that the page shows, by their kind."""
        return self._canvas.pictures

    # Layout

    def _build_header(self) -> None:
        with ui.header().classes("items-center no-wrap q-px-md q-py-none topbar"):
            ui.label("nlfilter-torch").classes("text-weight-medium text-body1")
            self._title = ui.label("").classes("hint q-ml-sm")
            ui.space()
            with ui.row().classes("items-center gap-2 no-wrap") as self._working:
                ui.spinner(size="20px", color="white")
                self._doing = ui.label("").classes("hint")
            self._working.set_visibility(False)
            photographs = self._upload(self._take_photograph, "image/*")
            presets = self._upload(self._take_preset, ".json,application/json")
            _button("Open", "folder_open", "A PNG, JPEG, TIFF or WebP file", js=_pick(photographs))
            _button("Undo", "undo", "Ctrl+Z", self._undo)
            _button("Redo", "redo", "Ctrl+Shift+Z", self._redo)
            _button("Load edit", "tune", "A saved edit, or sliders found by nlfilter-torch fit", js=_pick(presets))
            _button("Save edit", "bookmark_add", "For other photographs, and for the command line", self._ask_edit_name)
            _button("Save photo", "save", "At full size, into a file", self._ask_photo_name).props(
                "color=primary unelevated", remove="flat"
            )

    @staticmethod
    def _upload(action: Callable[[events.UploadEventArguments], Awaitable[None]], accept: str) -> ui.upload:
        upload = ui.upload(auto_upload=True, on_upload=action)
        return upload.props(f'accept="{accept}"').classes("hidden")

    # Changes

    def _change(self, step: str, entries: dict[str, Any], complete: bool) -> None:
        """Change entries of a step; ``complete`` when the pointer is released."""
        self.session.set(step, **entries)
        if complete:
            self.session.commit()
            self._changed()
        else:
            self._redraw(step)

    def _changed(self) -> None:
        """Show the edit after a complete change."""
        self._panel.follow()
        self._redraw()

    def _undo(self) -> None:
        if self.session.undo():
            self._changed()

    def _redo(self) -> None:
        if self.session.redo():
            self._changed()

    def _key(self, event: events.KeyEventArguments) -> None:
        if event.action.keydown and event.modifiers.ctrl and str(event.key).lower() == "z":
            self._redo() if event.modifiers.shift else self._undo()

    # Pictures

    def _redraw(self, upto: str | None = None) -> None:
        """Draw the picture again, once the drawing in progress is done."""
        self._canvas.draw_strokes()
        if self.session.opened is None:
            return
        self._wanted = [upto]
        if not self._drawing:
            self._start(self._keep_drawing())

    async def _keep_drawing(self) -> None:
        self._drawing = True
        try:
            while self._wanted:
                upto = self._wanted.pop()
                await self._run("Working", partial(self._canvas.draw, upto))
                self._canvas.show()
                self._draw_response()
                self._canvas.draw_mask(moving=upto is not None)
        finally:
            self._drawing = False

    def _draw_response(self) -> None:
        detail = self.session.recipe.last("detail")
        curves = [(OUTSIDE, detail["alpha"]), *([(INSIDE, detail.sliders_inside)] if detail.has_region() else [])]
        self._panel.draw_response(drawing.response_svg(self.session.preview.layers(detail).eigenvalues, curves))

    # Files

    def _begin(self, image: Path) -> None:
        if self.session.opened is None:  # a browser that reconnects keeps its edit
            self._start(self._open(lambda: self.session.open(image)))

    async def _take_photograph(self, event: events.UploadEventArguments) -> None:
        content = await event.file.read()
        event.sender.run_method("reset")
        self._start(self._open(lambda: self.session.open_bytes(content, event.file.name)))

    async def _open(self, read: Callable[[], None]) -> None:
        await self._run("Opening", read)
        opened = self.session.opened
        if opened is None:
            return
        self._title.set_text(opened.name)
        self._canvas.open(opened)
        self._changed()

    async def _take_preset(self, event: events.UploadEventArguments) -> None:
        content = await event.file.read()
        event.sender.run_method("reset")
        try:
            self.session.load_preset(content, event.file.name)
        except EXPECTED as error:
            self._show_error(str(error))
        else:
            self._changed()

    async def _ask_photo_name(self) -> None:
        if self.session.opened is None:
            self._show_error("open a photograph first; there is nothing to save")
            return
        await self._ask("Save the photograph", self.session.suggested_name(), self.session.save)

    async def _ask_edit_name(self) -> None:
        name = "edit" if self.session.opened is None else Path(self.session.opened.name).stem
        await self._ask("Save the edit", f"{name}.json", self.session.save_preset)

    async def _ask(self, title: str, name: str, save: Callable[[str], Path]) -> None:
        """Ask for a name, and whether to replace a file of that name, and save."""
        with self._client, ui.dialog() as dialog, ui.card().classes("dialog"):
            ui.label(title).classes("text-h6")
            field = ui.input("Name", value=name).props("outlined autofocus").classes("w-full")
            note = ui.label(f"In {self.session.folder.resolve()}").classes("hint")
            with ui.row().classes("w-full justify-end"):
                ui.button("Cancel", on_click=lambda: dialog.submit(None)).props("flat no-caps")
                ok = ui.button("Save").props("unelevated no-caps color=primary")

            def confirm() -> None:
                try:
                    exists = self.session.target(field.value).exists()
                except EXPECTED as error:
                    note.set_text(str(error))
                    return
                if exists and ok.text != "Replace":
                    ok.set_text("Replace")
                    note.set_text("A file of that name is there already.")
                    return
                dialog.submit(field.value)

            field.on_value_change(lambda: ok.set_text("Save"))
            field.on("keydown.enter", confirm)
            ok.on_click(confirm)
        chosen = await dialog
        dialog.delete()
        if chosen is not None:
            self._start(self._save(save, chosen))

    async def _save(self, save: Callable[[str], Path], name: str) -> None:
        path: Path = await self._run("Saving", lambda: save(name))
        with self._client:
            ui.notify(f"Saved {path.resolve()}", type="positive", position="bottom-left", timeout=6000)

    # Work

    def _start(self, work: Awaitable[None]) -> None:
        """Run a task in the background, and report its failure."""
        background_tasks.create(self._reported(work))

    async def _reported(self, work: Awaitable[None]) -> None:
        try:
            await work
        except EXPECTED as error:
            self._show_error(str(error))
        except Exception:
            self._show_error("this failed, and it is not your fault; the terminal that runs the editor shows more")
            raise  # for the log

    def _show_error(self, sentence: str) -> None:
        with self._client:
            ui.notify(sentence, type="negative", position="bottom", timeout=10000, close_button="OK", multi_line=True)

    async def _run(self, doing: str, work: Callable[[], Any]) -> Any:
        """Run something in a thread; the page shows ``doing`` if it takes long."""
        task = asyncio.ensure_future(asyncio.to_thread(work))
        done, _ = await asyncio.wait({task}, timeout=PATIENCE)
        if not done:
            self._doing.set_text(f"{doing}\u2026")
            self._working.set_visibility(True)
            await asyncio.wait({task})
            self._working.set_visibility(False)
        return await task


def _button(
    label: str, icon: str, tip: str, action: Callable[[], Any] | None = None, *, js: str | None = None
) -> ui.button:
    button = ui.button(label, icon=icon, on_click=action).props("flat no-caps dense color=white").classes("q-px-sm")
    if js is not None:
        button.on("click", js_handler=js)
    return button.tooltip(tip)


def _pick(upload: ui.upload) -> str:
    """JavaScript that lets the user choose a file for an upload."""
    return f"() => getElement({upload.id}).$refs.qRef.pickFiles()"
