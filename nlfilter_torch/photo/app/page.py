"""The editor's page: the canvas, the controls beside it, and the reactions to them."""

import asyncio
import secrets
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from urllib.parse import quote

from fastapi import Response
from nicegui import events, ui
from nicegui.elements.upload_files import FileUpload
from torch import Tensor

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.access import LARGEST_UPLOAD
from nlfilter_torch.photo.app.canvas import Canvas
from nlfilter_torch.photo.app.closeup import AtRest, Closeup
from nlfilter_torch.photo.app.developed import DEVELOPING, Developed
from nlfilter_torch.photo.app.dialogs import EXPECTED, Arguments, NameDialog, Question, SaveDialog, Tasks, Upload
from nlfilter_torch.photo.app.filmstrip import Filmstrip
from nlfilter_torch.photo.app.library import Library
from nlfilter_torch.photo.app.panel import Panel
from nlfilter_torch.photo.app.server import SCRIPTS, STATIC
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.shots import Shot
from nlfilter_torch.photo.app.tabs import thumbnails
from nlfilter_torch.photo.app.tools import FREE, Brush, Proportions
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import DETAIL, EDITS
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.strokes import sliders_of

LARGEST_PRESET = 20_000_000  # bytes
PHOTOGRAPH_KINDS = "image/*,.heic,.heif"  # browsers do not call the latter images
PRESET_KINDS = ".json,.cube,.png,.tif,.tiff,.jpg,.jpeg,application/json"
REPLACING = (
    "Colorize is for grey photographs: the colours of this one would all be replaced by those that you paint. "
    "Recolor changes the colour of an object, and keeps the rest."
)
TURNING = {"n": 1, "p": -1}  # keys that show the next photograph, and the previous one
INSIDE, OUTSIDE = "#4ade80", "#60a5fa"  # colours of the sliders' response in the region, and elsewhere
REST = 0.5  # seconds after a sketch without a change, after which it is completed
EDITORS: dict[str, "Editor"] = {}  # open pages by the token in the addresses of their pictures


class Editor:
    """One tab of the browser, and the session of the photograph that it shows."""

    def __init__(self, photographs: Library) -> None:
        self._photographs = photographs
        self.session: Session | None = None
        self.brush = Brush()
        self._told: str | None = None  # the last trouble of the session that was shown
        self._token = secrets.token_urlsafe(16)
        self._pictured: Developed | None = None  # what thumbnails of looks show
        self._picturing = 0  # how often they were drawn, so that browsers do not show others
        self._wanted: list[int | None] = []  # at most one picture to draw next: the place of a step that moves, or None
        self._drawing = self._completing = self._incomplete = False
        self._responding = self._response_wanted = False  # whether the response of the sliders is computed, and again
        self._is_sketch = self._is_moving = False  # whether the picture shown is a sketch, and of a slider that moves
        self._awaited: list[str] = []  # names of the photographs that were chosen last
        self._framed: object = None  # what canvas and closeup show
        self.is_cropping = False
        self.proportions = Proportions()

    def build(self, images: Sequence[Path], address: str = "", tab: str = "", roll: str = "") -> None:
        """Lay the page out, and open the photograph and tab of an address that the page had before, or the first image.

        ``roll`` names the photographs of its strip, which are the images at first.
        """
        image = images[0] if images else None
        self._roll = roll if roll in self._photographs.rolls else self._token
        shots = () if address else map(self._photographs.shot, images)
        self._shots = self._photographs.rolls.setdefault(self._roll, {shot.address: shot for shot in shots})
        EDITORS[self._token] = self
        self._client = ui.context.client
        self._client.on_delete(self._leave)
        ui.add_css(STATIC / "page.css")
        ui.add_head_html(SCRIPTS)
        self._build_header()
        self._closeup = Closeup(self._tasks, self._tell)
        self._at_rest = AtRest(self._tasks, self._is_preview, self._take)
        with ui.element("div").classes("editor"):
            with ui.element("div").classes("viewer"):
                self._canvas = Canvas(self.brush, self._token, self._draw, self._lay, self._upload.choosing)
                self._filmstrip = Filmstrip(
                    self._photographs,
                    self._shots,
                    self._tasks,
                    lambda: self.session,
                    self._turn_to,
                    self._follow_all,
                    self._token,
                )
            with ui.column().classes("panel") as self._side:
                handle = ui.button(icon="drag_handle").props('flat dense aria-label="Show or hide the controls"')
                handle.classes("handle").on("click", js_handler="() => page.fold()")
                self._panel = Panel(self, self._switch, tab)
        self._canvas.switch(self._panel.tab)
        self._tasks.sign.move(self._canvas.place)
        if image is not None or address:
            self._wait("Opening\u2026")
        ui.keyboard(on_key=self._key, ignore=["input", "select", "textarea"])
        ui.on("closeup", lambda event: self._look(event.args))
        ui.on("stroke_dropped", self._canvas.drop_stroke)
        ui.on("save_photo", self._ask_photo_name)
        ui.on("tool", lambda event: self._panel.take(event.args))
        ui.on("crop", lambda event: self._crop(event.args))
        ui.on("crop_done", lambda: self.toggle_crop() if self.is_cropping else None)
        self._client.on_connect(lambda: self._begin(image, address))

    def _wait(self, doing: str = "") -> None:
        """Show that the picture is not there yet, or not as it is edited, and let the controls rest; "" ends this."""
        self._tasks.say(self, doing)
        self._canvas.wait(bool(doing))
        self._side.props("inert" if doing else "", remove="" if doing else "inert")

    def recipe(self) -> Recipe:
        """The current edit."""
        return Recipe() if self.session is None else self.session.recipe

    @property
    def is_picking(self) -> bool:
        """Whether the next click on the photograph chooses what is grey."""
        return self._canvas.pick is not None

    def _opened(self, purpose: str) -> Session | None:
        """The session; None, and an error that names the purpose, if no photograph is open."""
        if self.session is None:
            self._tasks.show_error(f"open a photograph first; there is nothing {purpose}")
        return self.session

    def picture(self, kind: str, place: str) -> bytes | None:
        """The file of a picture that the page shows, by its kind; of the original at a place."""
        if kind == "original":
            return self._closeup.original(place)
        return self._canvas.pictures.get(kind) or self._closeup.file(kind) or self._filmstrip.picture(kind)

    def thumbnail(self, look: str) -> str:
        """The address of a picture of the photograph under a look, or "" if there is none."""
        kind = f"look-{look}"
        return f"/picture/{self._token}/{kind}?{self._picturing}" if kind in self._canvas.pictures else ""

    def _tell(self, script: str) -> None:
        if not self._client.is_deleted:
            self._client.run_javascript(script)

    def _leave(self) -> None:
        EDITORS.pop(self._token, None)
        self._closeup.stop()

    # Layout

    def _build_header(self) -> None:
        with ui.header().classes("items-center no-wrap q-py-none topbar"):
            ui.label("nlfilter-torch").classes("text-weight-medium text-body1 wide")
            self._title = ui.label("").classes("hint q-ml-sm ellipsis title")
            ui.space()
            self._tasks = Tasks()
            show_error = self._tasks.show_error
            self._upload = Upload(
                self._take_photograph,
                PHOTOGRAPH_KINDS,
                LARGEST_UPLOAD,
                show_error,
                several=True,
                begin=self._await_photographs,
            )
            presets = Upload(self._take_preset, PRESET_KINDS, LARGEST_PRESET, show_error)
            kinds = f"A PNG, JPEG, TIFF, WebP, AVIF or HEIC file of at most {LARGEST_UPLOAD / 1e9:g} GB"
            _button("Open", "folder_open", kinds, js=self._upload.choosing)
            self._undo_button = _button("Undo", "undo", "Ctrl+Z", self._undo)
            self._redo_button = _button("Redo", "redo", "Ctrl+Shift+Z", self._redo)
            self._reset_button = _button(
                "Reset", "restart_alt", "Begin the edit anew; Undo brings it back", self._reset
            )
            _button(
                "Load edit",
                "tune",
                "A saved edit, a look found by nlfilter-torch fit, or a colour table (.cube or a Hald)",
                js=presets.choosing,
            )
            _button("Save edit", "bookmark_add", "For other photographs, and for the command line", self._ask_edit_name)
            _button("Save photo", "save", "At full size, into a file; Ctrl+S", self._ask_photo_name).props(
                "color=primary unelevated", remove="flat"
            )

    # Changes

    def change(self, step: str, values: Mapping[str, Value], complete: bool) -> None:
        """Change parameters of a step; ``complete`` when the pointer is released."""
        if self.session is None:  # it would be lost when one is opened
            self._panel.follow()
            return
        self.session.set(step, strokes=None, **values)
        self._follow_change(self.session, None if complete else self.session.recipe.place_of(step))

    def replace(self, recipe: Recipe, moving: int | None) -> None:
        """Replace the edit; ``moving`` is the place of a step whose slider moves, or None if the change is complete."""
        if self.session is not None:
            self.session.recipe = recipe
            self._follow_change(self.session, moving)

    def develop(self, values: Mapping[str, Value], complete: bool) -> bool:
        """Change how the photograph is developed, and return whether it can be; ``complete`` at the end of a drag."""
        session = self.session
        if session is None:
            self._panel.follow()
            return False
        try:
            recipe = session.developing(values, self.proportions.aspect(session.turned_size))
        except ValueError as error:  # the middle of the crop would be outside
            self._tasks.show_error(str(error))
            self._panel.follow()
            if self.is_cropping:  # and back to the frame of before
                self._tasks.start(self._show_crop())
            return False
        if "crop" in values:
            self.proportions.kept |= {recipe.develop.crop}
        self.replace(recipe, None if complete else DEVELOPING)
        return True

    def turn(self, quarters: int) -> None:
        """Turn the photograph clockwise by quarters of a circle; the crop shows the same."""
        session = self._opened("to turn")
        if session is not None:
            self.proportions = Proportions()
            self.replace(replace(session.recipe, develop=session.recipe.develop.quartered(quarters)), None)

    def toggle_pick(self) -> None:
        """Let the next click on the photograph choose what is grey, or no longer."""
        session = self._opened("grey to point at")
        if session is None:
            return
        self._end_crop()
        self._canvas.await_click(None if self.is_picking else partial(self._balance, session))
        self._panel.follow()

    def _balance(self, session: Session, x: float, y: float) -> None:
        """Make the photograph grey at a point (x, y) in pixels of the preview."""
        try:
            values = session.balance(x, y)
        except ValueError as error:
            self._tasks.show_error(str(error))
            self._panel.follow()
        else:
            self.develop(values, True)

    def toggle_crop(self) -> None:
        """Show the frame of the crop over the whole photograph, or hide it."""
        if self._opened("to crop") is None:
            return
        if self.is_cropping:
            self._end_crop()
        else:
            self.is_cropping = True
            self._canvas.await_click(None)
            self._tasks.start(self._show_crop())
        self._panel.follow()

    def _end_crop(self) -> None:
        """Hide the frame of the crop."""
        if self.is_cropping:
            self.is_cropping = False
            self._canvas.hide_crop()

    async def _show_crop(self) -> None:
        """Show the frame of the crop as it is now."""
        await self._tasks.run("Working", self._canvas.draw_whole)
        if self.is_cropping and self.session is not None and not self._client.is_deleted:
            height, width = self.session.turned_size
            aspect = self.proportions.aspect((height, width))
            with self._client:
                self._canvas.show_crop(None if aspect is None else aspect * height / width)

    def hold(self, name: str) -> None:
        """Let the crop keep proportions from now on, and cut it to them."""
        session = self._opened("to crop")
        if session is not None:
            self._cut(session, name)
        self._panel.follow()

    def _cut(self, session: Session, name: str) -> None:
        """Cut the crop to proportions, and show its frame; with :data:`FREE`, only let its frame be dragged freely."""
        before = self.proportions
        if name == FREE:
            before.name = FREE
            if self.is_cropping:
                self._tasks.start(self._show_crop())
            return
        self.proportions = replace(before, name=name, kept=frozenset())
        if not self.develop({"crop": self.proportions.begin(session.recipe.develop.crop)}, True):
            self.proportions = replace(before, cut=None)  # the next cut begins with the crop as it is
            return
        self.proportions.cut = session.recipe.develop.crop
        if not self.is_cropping:
            self.toggle_crop()

    def _crop(self, edges: Sequence[float]) -> None:
        """Take the edges that a person has set."""
        if len(edges) == 4 and self.is_cropping:
            self.develop({"crop": tuple(float(edge) for edge in edges)}, True)

    def _follow_change(self, session: Session, moving: int | None) -> None:
        """Show a changed edit, quickly while a slider of a step moves."""
        if moving is None:
            session.commit()
            self._changed()
        else:
            self._closeup.hold()
            self._redraw(moving)

    def _draw(self, step: str, add: Callable[[], None]) -> None:
        """Add a stroke to a step, after a question if the photograph would lose its colours."""
        is_first = EDITS[step].coloured and not self.recipe().current(step).strokes
        if is_first and self.session is not None and self.session.has_colours:
            self._tasks.start(self._ask_to_colorize(add))
        else:
            add()
            self._changed()

    async def _ask_to_colorize(self, add: Callable[[], None]) -> None:
        with self._client:
            question = Question("Replace all colours?", REPLACING, "Replace all colours")
        if await question.answer():
            add()
            self._changed()

    def clear(self, step: str) -> None:
        """Remove the strokes of a step."""
        if self.session is not None:
            self.session.set(step, strokes=())
            self.session.commit()
            self._changed()

    def _changed(self) -> None:
        """Show the edit after a complete change, in all tabs."""
        self._tasks.clear_error()
        for editor in list(EDITORS.values()):
            if editor.session is self.session:
                editor.follow()
        self._follow_photographs()

    def _follow_all(self) -> None:
        """Show the edits of all photographs, in all tabs."""
        self._tasks.clear_error()
        for editor in list(EDITORS.values()):
            editor.follow()
        self._follow_photographs()

    def follow(self) -> None:
        """Show the edit."""
        recipe = self.recipe()
        self.proportions.follow(recipe.develop.crop)
        self._panel.follow()
        self._show_state()
        self._redraw()
        if self._framed == (self.session, recipe.develop.geometry):
            self._closeup.follow()
        else:
            self._closeup.hold()  # until the photograph is cut anew

    def _show_state(self) -> None:
        """Show what can be undone, and whether the edit is kept."""
        session = self.session
        self._undo_button.set_enabled(session is not None and session.can_undo)
        self._redo_button.set_enabled(session is not None and session.can_redo)
        self._reset_button.set_enabled(self.recipe() != Recipe())
        unsaved = session is not None and session.unsaved
        self._client.run_javascript(f"page.isUnsaved = {'true' if unsaved else 'false'}")
        trouble = None if session is None else session.trouble
        if trouble != self._told:
            self._told = trouble
            if trouble is not None:
                self._tasks.show_error(trouble)

    def _undo(self) -> None:
        if self.session is not None and self.session.undo():
            self._changed()

    def _redo(self) -> None:
        if self.session is not None and self.session.redo():
            self._changed()

    def _turn_to(self, shot: Shot) -> None:
        """Show another photograph of the strip."""
        self._tasks.start(self._open(self._photographs.session, shot))

    def _reset(self) -> None:
        if self.session is not None:
            self.proportions = Proportions()
            self.session.load(Recipe())
            self._changed()

    def _key(self, event: events.KeyEventArguments) -> None:
        if not event.action.keydown:
            return
        key, shift = str(event.key).lower(), event.modifiers.shift
        actions = {"z": self._redo if shift else self._undo}
        if shift:
            actions |= {"c": self._filmstrip.copy, "v": self._filmstrip.paste}
        if event.modifiers.ctrl and key in actions:
            actions[key]()
        elif key in TURNING and not (shift or event.modifiers.alt or event.modifiers.meta or event.modifiers.ctrl):
            self._filmstrip.turn(TURNING[key])

    # Pictures

    def _redraw(self, moving: int | None = None) -> None:
        """Draw the picture again, once the drawing in progress is done; quickly while a slider of a step moves."""
        self._canvas.draw_strokes()
        if self.session is None:
            return
        self._wanted = [moving]
        if not self._drawing:
            self._tasks.start(self._keep_drawing())

    async def _keep_drawing(self) -> None:
        """Draw what is wanted: large photographs at once as a sketch, which is completed beside further sketches."""
        self._drawing = True
        try:
            while self._wanted:
                moving = self._wanted.pop()
                if self.is_cropping:
                    await self._show_crop()
                    if moving == DEVELOPING:
                        continue
                self._is_sketch = await self._tasks.run("Working", self._canvas.sketch, moving)
                self._is_moving = moving is not None
                if self._is_sketch:
                    self._show()
                    self._wait()
                    self._canvas.draw_mask(moving=True)
                    self._closeup.show_nearly()
                elif moving is not None:
                    await self._draw_completely(moving)
                if moving is None:
                    self._incomplete = True
                    if not self._completing:
                        self._tasks.start(self._complete())
        finally:
            self._drawing = False
            if not self._incomplete and not self._completing:
                self._wait()

    async def _complete(self) -> None:
        """Draw the preview itself, until it is that of the current edit."""
        self._completing = True
        try:
            while self._incomplete:
                self._incomplete = False
                if self._is_sketch:  # a person often goes on at once
                    self._tasks.say(self._canvas, "Working\u2026")
                    await asyncio.sleep(REST)
                    if self._incomplete or self._is_moving:
                        continue
                await self._draw_completely(None)
        finally:
            self._completing = False
            self._tasks.say(self._canvas)
            self._wait()
        if self.session is not None:
            self._at_rest.drawn(self.session)

    async def _draw_completely(self, moving: int | None) -> None:
        await self._tasks.run("Working", self._canvas.draw, moving)
        if moving is None:
            self._frame()
        self._show()
        self._wait()
        self._closeup.show_nearly()
        if moving is None and self.session is not None and self._pictured is not self.session.developed:
            self._pictured = self.session.developed
            self._tasks.start(self._draw_looks(self.session.developed))
            self._prepare()
        if self._panel.tab == DETAIL.name:
            self._tasks.start(self._respond())
        self._canvas.draw_mask(moving=moving is not None)
        self._canvas.draw_strokes()

    async def _draw_looks(self, developed: Developed) -> None:
        """Draw thumbnails of the photograph, as it is developed, under each look."""
        try:
            pictures = await self._tasks.run("Looks", thumbnails, developed.preview.pixels)
        except BaseException:
            self._pictured = None  # so that they are drawn again
            raise
        if self.session is not None and self.session.developed is developed and not self._client.is_deleted:  # still
            self._picturing += 1
            self._canvas.pictures |= {f"look-{look}": content for look, content in pictures.items()}
            self._panel.follow()

    def _lay(self) -> None:
        """Show the mask and the strokes of the open tab."""
        if self.session is not None:
            self._tasks.start(self._lay_over())

    async def _lay_over(self) -> None:
        await self._tasks.run("Working", self._canvas.lay_over)
        self._canvas.show_layers()

    def _show(self) -> None:
        """Show the picture that the canvas has taken, and its histogram."""
        self._canvas.show()
        self._panel.draw_tones(self._canvas.histogram_before)
        self._panel.draw_levels(self._canvas.histogram, self._canvas.clipped, self._canvas.clipped_before)

    def _take(self, picture: Tensor) -> None:
        self._canvas.take(picture)
        self._show()

    def _look(self, view: Sequence[float] | None) -> None:
        """Show a part at full size, or the whole photograph if ``view`` is None."""
        self._closeup.look(view)
        if view is None and self.session is not None:
            self._at_rest.drawn(self.session)

    def _is_preview(self, session: object) -> bool:
        """Whether the page shows the preview of a session, and nothing is being drawn or moved."""
        is_drawing = self._drawing or self._completing or bool(self._wanted)
        return self.session is session and not (self._client.is_deleted or is_drawing or self._closeup.is_busy)

    def _frame(self) -> None:
        """Show the photograph as it is straightened and cropped now, if that has changed."""
        session = self.session
        if session is not None and self._framed != (now := (session, session.developed.development.geometry)):
            self._framed = now
            self._closeup.open(session)
            with self._client:
                self._canvas.frame()
            self._closeup.follow()

    async def _respond(self) -> None:
        """Show the response of the sliders for the layers."""
        self._response_wanted = True
        if self._responding:
            return
        self._responding = True
        try:
            while self._response_wanted and self.session is not None:
                self._response_wanted = False
                detail = self.session.recipe.current(DETAIL.name)
                regions = sliders_of(detail.strokes, detail.sliders_inside)
                curves = [(OUTSIDE, detail["alpha"]), *((INSIDE, row) for row in regions)]
                eigenvalues = await self._tasks.run("Working", self.session.eigenvalues, detail)
                self._panel.draw_response(drawing.response_svg(eigenvalues, curves))
        finally:
            self._responding = False

    def _switch(self, tab: str) -> None:
        """Show what belongs to a tab that was opened."""
        was_pointing = self.is_cropping or self.is_picking
        self._end_crop()
        self._canvas.switch(tab)
        if was_pointing:
            self._panel.follow()
        if tab == DETAIL.name and self.session is not None:
            self._tasks.start(self._respond())
        self._remember()
        self._prepare()

    def _prepare(self) -> None:
        """Let the first move of a slider of the open tab be fast."""
        if self.session is not None:
            self._tasks.start(asyncio.to_thread(self.session.prepare, self._panel.tab))

    def _remember(self) -> None:
        """Let the address of the page be that of its photographs and tab, for a reload."""
        if self.session is not None:
            roll = f"roll={self._roll}&" if len(self._shots) > 1 else ""
            ui.navigate.history.replace(f"/?{roll}photo={quote(self.session.address)}&tab={self._panel.tab}")

    # Files

    def _begin(self, image: Path | None, address: str) -> None:
        self._client.run_javascript(f"page.watchConnection(); {self._upload.dropping}")
        self._show_state()
        if self.session is not None:  # a browser that reconnects keeps its edit
            return
        if address and (image is None or address != image.name):
            self._tasks.start(self._open(self._photographs.reopen, address))
        elif image is not None:
            self._tasks.start(self._open(self._photographs.open, image))

    async def _take_photograph(self, event: events.UploadEventArguments) -> None:
        self._tasks.start(self._open_upload(event.file))

    def _await_photographs(self, names: list[str]) -> None:
        """Know the names of the files that the browser is about to send, in any order."""
        self._awaited = names

    async def _open_upload(self, file: FileUpload) -> None:
        """Take a photograph into the strip, and show it if it is the first of those that were chosen together."""
        with tempfile.TemporaryDirectory(prefix="nlfilter-torch-") as folder:
            copy = Path(folder) / "photograph"
            await file.save(copy)
            shot = await self._tasks.run("Opening", self._photographs.shot_of_upload, copy, file.name)
        if file.name in self._awaited[:1] or (self.session is None and not self._awaited):
            await self._open(self._photographs.session, shot)
        else:
            self._take_in(shot)
            self._follow_photographs()
            with self._client:
                self._remember()

    def _take_in(self, shot: Shot) -> None:
        """Put a photograph into the strip, where those that were chosen together stand in their order."""
        self._shots[shot.address] = shot
        places = {name: place for place, name in enumerate(self._awaited)}
        ordered = sorted(self._shots.items(), key=lambda item: places.get(item[1].name, -1))
        self._shots.clear()
        self._shots.update(ordered)

    def _follow_photographs(self) -> None:
        """Show the photographs that are open, in all tabs."""
        for editor in list(EDITORS.values()):
            editor._filmstrip.follow()

    async def _open(self, find: Callable[[*Arguments], Session], *place: *Arguments) -> None:
        self._wait("Opening\u2026")
        try:
            self.session = session = await self._tasks.run("Opening", find, *place)
        except BaseException:
            self._wait()
            raise
        if self._client.is_deleted:
            return
        self._take_in(self._photographs.shot_of(session))
        self._title.set_text(session.name)
        self._tasks.clear_error()
        self._closeup.open(session)
        self._framed = session, session.developed.development.geometry
        with self._client:
            self._end_crop()
            self.proportions = Proportions()
            self._canvas.await_click(None)
            self._canvas.open(session)
        self._wait("Opening\u2026" if session.recipe == Recipe() else "Applying the edit\u2026")
        self.follow()
        self._follow_photographs()
        with self._client:
            self._remember()
            if session.pages > 1:
                ui.notify(
                    f"{session.name} has several pages; the first is shown.", position="bottom-left", timeout=8000
                )
            if session.recipe != Recipe():
                ui.notify("The edit is as you left it. Reset begins anew.", position="bottom-left", timeout=4000)

    async def _take_preset(self, event: events.UploadEventArguments) -> None:
        content = await event.file.read()
        session = self._opened("to edit")
        if session is None:
            return
        try:
            session.load_preset(content, event.file.name)
        except EXPECTED as error:
            self._tasks.show_error(str(error))
        else:
            self._changed()

    async def _ask_photo_name(self) -> None:
        session = self._opened("to save")
        if session is None:
            return
        side, name = max(session.size), session.suggested_name()
        with self._client:
            dialog = SaveDialog("Save the photograph", name, session.folder, session.check_photograph, side)
        chosen = await dialog.answer()
        if chosen is not None:
            progress = Progress()
            self._tasks.start(self._save(progress, session.save, chosen, progress, *dialog.options))

    async def _ask_edit_name(self) -> None:
        session = self._opened("to save")
        if session is None:
            return
        name = f"{Path(session.name).stem}.json"
        with self._client:
            dialog = NameDialog("Save the edit", name, session.folder, session.check_preset)
        chosen = await dialog.answer()
        if chosen is not None:
            self._tasks.start(self._save(Progress(), session.save_preset, chosen))

    def cut_out(self, step: str) -> None:
        """Ask for a name, and save the object that a step marks on transparent ground."""
        self._tasks.start(self._ask_cutout_name(step))

    async def _ask_cutout_name(self, step: str) -> None:
        session = self._opened("to cut out of")
        if session is None:
            return
        name = f"{Path(session.name).stem}-cut.png"
        with self._client:
            dialog = NameDialog("Cut out the object", name, session.folder, session.check_cutout)
        chosen = await dialog.answer()
        if chosen is not None:
            progress = Progress()
            self._tasks.start(self._save(progress, session.cut_out, chosen, step, progress))

    async def _save(self, progress: Progress, save: Callable[[*Arguments], Path], *arguments: *Arguments) -> None:
        path = await self._tasks.run("Saving", save, *arguments, progress=progress)
        self._tasks.clear_error()
        if self._client.is_deleted:
            return
        self._show_state()
        with self._client:
            ui.notify(f"Saved {path.resolve()}", type="positive", position="bottom-left", timeout=6000)


@dataclass(frozen=True)
class Pages:
    """The pages of the editor, which begin with some images, or with none."""

    photographs: Library
    images: Sequence[Path]

    def build(self, photo: str = "", tab: str = "", roll: str = "") -> None:
        """Build a page, for the photographs and tab of an address that a page had before, if there is one."""
        Editor(self.photographs).build(self.images, photo, tab, roll)

    def picture(self, token: str, kind: str, at: str = "") -> Response:
        """A picture of the page with a token, by its kind, of the original at a place; or status 404.

        The whole photograph, thumbnails and what is only near are JPEG files, and all else PNG files.
        """
        editor = EDITORS.get(token)
        content = None if editor is None else editor.picture(kind, at)
        if not content:
            return Response(status_code=404)
        is_jpeg = kind in ("before", "after") or kind.startswith(("near-", "shot-"))
        media_type = "image/jpeg" if is_jpeg else "image/png"
        return Response(content, media_type=media_type, headers={"Cache-Control": "no-store"})


def _button(
    label: str, icon: str, tip: str, action: Callable[[], object] | None = None, *, js: str | None = None
) -> ui.button:
    button = ui.button(label, icon=icon, on_click=action).props("flat no-caps dense color=white").classes("q-px-sm")
    button.props(f'aria-label="{label}"')
    if js is not None:
        button.on("click", js_handler=js)
    return button.tooltip(tip)
