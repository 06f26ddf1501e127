"""The large picture with its overlays, and the brush that draws on it."""

from collections.abc import Callable
from functools import partial

from nicegui import ui
from torch import Tensor

from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.tools import BRUSHES, Brush, CropTool
from nlfilter_torch.photo.declared.development import DEVELOP
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.strokes import Mark

LEAST_SIDE = 3  # pixels of the preview, of a box; less is a click
Draw = Callable[[str, Callable[[], None]], None]  # adds a stroke to a step


class Canvas:
    """A photograph with its mask, its scribbles and the version before the edit, built into the open element.

    Args:
        brush: what draws.
        token: part of the addresses of the pictures.
        draw: is called with the step and the function that adds a complete stroke to it.
        lay: is called when :meth:`lay_over` is to be called, in a thread, and then :meth:`show_layers`.
        choosing: JavaScript that lets a person choose a photograph.

    Attributes:
        place: what holds the picture.
        pictures: image files, by their kind.
        pick: is called with the next point (x, y) that is clicked, in pixels of the preview, or None.
    """

    def __init__(self, brush: Brush, token: str, draw: Draw, lay: Callable[[], None], choosing: str) -> None:
        self.pictures: dict[str, bytes] = {}
        self.histogram = self.histogram_before = ""
        self.clipped = self.clipped_before = (0.0, 0.0)  # shares of white and of black, after and before the edit
        self.pick: Callable[[float, float], None] | None = None
        self._session: Session | None = None
        self._preview_size = self._whole_size = (1, 1)
        self._brush, self._token, self._draw, self._lay = brush, token, draw, lay
        self._frame = 0
        self._flashes = 0
        self._mask_shown: bytes | None = None  # the mask that was shown last
        self._step = DEVELOP.name  # the tab that is open, whose strokes are shown
        self._line: list[tuple[float, float]] = []  # of the stroke that is being drawn
        with ui.element("div").classes("canvas") as self.place:
            self._build_welcome(choosing)
            self._build_photo()
            self._crop_tool = CropTool()
            _build_zoom()
        self._build_bar()

    def _build_welcome(self, choosing: str) -> None:
        with ui.element("button").classes("welcome").props('type="button"') as self._welcome:
            ui.icon("photo", size="64px")
            ui.label("Open a photograph to begin").classes("text-h6 q-mt-sm")
            ui.label("Click here, or drop one or more: PNG, JPEG, TIFF, WebP, AVIF or HEIC.").classes("hint")
            ui.label("It stays on this machine.").classes("hint")
        self._welcome.on("click", js_handler=choosing)

    def _build_photo(self) -> None:
        self._photo = ui.interactive_image(
            events=["pointerdown", "pointermove", "pointerup", "pointerleave"], sanitize=False
        ).classes("photo")
        with self._photo:
            ui.element("div").classes("over pieces")
            self._mask = ui.element("img").classes("over mask").props('alt="mask"')
            self._ignored = ui.element("img").classes("over ignored").props('alt="parts of strokes that do not count"')
            self._clipped = ui.element("img").classes("over").props('alt="clipped"')
            self._before = ui.element("img").classes("over before").props('alt="before"')
            ui.element("div").classes("over before originals")
            ui.element("div").classes("edge")
            ui.label("before").classes("tag")
        self._photo.on(
            "mouse", lambda event: self._pointer(*event.args), js_handler="(event) => page.point(event, emit)"
        )
        for element in (self._photo, self._clipped, self._mask, self._ignored):
            element.set_visibility(False)

    def _build_bar(self) -> None:
        with ui.row().classes("bar"):
            ui.label("Before").classes("hint")
            wipe = ui.slider(min=0, max=100, value=0).style("max-width: 320px")
            wipe.props('dense aria-label="Before and after"')
            wipe.on("update:model-value", js_handler="(share) => closeup.wipe(share)")
            self._show_strokes = ui.checkbox("Strokes", value=True, on_change=self.draw_strokes).props("dense")
            self._show_mask = ui.checkbox("Mask", value=False, on_change=self._follow_view).props("dense")
            self._show_mask.tooltip("Show what the strokes select").set_enabled(False)
            self._is_plain = ui.checkbox("B/W", value=False, on_change=self._follow_view).props("dense")
            self._is_plain.props('aria-label="B/W: black and white"').tooltip("Show the mask in black and white")
            self._is_plain.set_visibility(False)
            self._show_clipped = ui.checkbox("Clipped", value=False, on_change=self._draw_clipped)
            self._show_clipped.props("dense").tooltip("Mark what has become white (red) or black (blue)")
            ui.space()
            self._size = ui.label("").classes("hint wide")

    def open(self, session: Session) -> None:
        """Show a photograph that was opened, first its preview."""
        self._session = session
        self._edited = session.developed.before.clamp(0, 1)
        self._mask_shown = None
        self.pictures = {}
        self.frame()
        self._show("before", self._photo)
        self._welcome.set_visibility(False)
        self._photo.set_visibility(True)

    def wait(self, is_waiting: bool) -> None:
        """Show that the photograph is not there yet, or not as it is edited; without one, ask for it afterwards."""
        self._welcome.set_visibility(self._session is None and not is_waiting)
        self._photo.classes(add="waiting" if is_waiting else "", remove="" if is_waiting else "waiting")

    def frame(self) -> None:
        """Show the photograph as it is straightened and cropped now, with its preview before the edit."""
        if self._session is None:
            return
        before = self._session.developed.before.clamp(0, 1)
        self._preview_size = (before.shape[-2], before.shape[-1])
        (height, width), (preview_height, preview_width) = self._session.size, self._preview_size
        self._size.set_text(f"{width}\u00d7{height} pixels, shown at {preview_width}\u00d7{preview_height}")
        fitting = f"min(100cqw, calc(100cqh * {preview_width / preview_height:.4f}))"
        self._photo.style(f"width: var(--photo-width, {fitting})")
        ui.run_javascript(f"closeup.open({width}, {height}, '/picture/{self._token}')")
        self.pictures["before"] = drawing.picture(before)
        self.histogram_before = drawing.histogram_svg(before)
        self.clipped_before = drawing.clipped_shares(before)
        self._show("before", self._before)

    def draw_whole(self) -> None:
        """Compute the picture without a crop; may run in a thread."""
        if self._session is not None:
            whole = self._session.uncropped
            self._whole_size = (whole.shape[-2], whole.shape[-1])
            self.pictures["whole"] = drawing.picture(whole)

    def show_crop(self, aspect: float | None = None) -> None:
        """Show this picture, and the frame of the crop over it, which keeps an aspect, see :meth:`CropTool.show`."""
        if self._session is not None:
            self._crop_tool.show(self._address("whole"), self._whole_size, self._session.crop, aspect)

    def hide_crop(self) -> None:
        """Show the photograph as it is cropped."""
        self._crop_tool.hide()

    def await_click(self, pick: Callable[[float, float], None] | None) -> None:
        """Call a function with the next point that is clicked, in place of drawing; None ends this."""
        self.pick = pick
        draws = self._step in BRUSHES or pick is not None  # or picks a point, rather than moving the photograph
        ui.run_javascript(f"closeup.brush({'true' if draws else 'false'})")

    def switch(self, step: str) -> None:
        """Show the strokes of another step."""
        if step != self._step:
            self.pictures.update(mask=b"", ignored=b"")
        self._step = step
        self._show_mask.set_enabled(step in BRUSHES and bool(EDITS[step].with_role("added")))  # others select nothing
        self._lay()
        self.await_click(None)
        self.draw_strokes()
        self.draw_mask()

    def draw(self, moving: int | None) -> None:
        """Compute the picture and its mask, quickly while a slider of a step moves; may run in a thread.

        A complete picture is not shown if the edit has changed meanwhile.
        """
        session = self._session
        if session is None:
            return
        recipe, picture = session.recipe, session.render(moving)
        if session is self._session and (moving is not None or session.recipe.effect == recipe.effect):
            self.take(picture)
            self.lay_over(moving=moving is not None)

    def sketch(self, moving: int | None) -> bool:
        """Compute the picture at once, approximately, and return whether that was possible; may run in a thread."""
        session = self._session
        picture = None if session is None else session.draft(moving)
        if picture is None or session is not self._session:
            return False
        self.take(picture)
        return True

    def lay_over(self, *, moving: bool = False) -> None:
        """Compute the mask, if it may be shown, and what does not count of the strokes; may run in a thread."""
        session, step = self._session, self._step
        if session is None or step not in BRUSHES:
            return
        keep = bool(self._show_mask.value)
        mask = None
        if EDITS[step].regional is not None or (keep and not moving):
            mask = session.mask(step)
        content = b"" if mask is None else self._mask_file(mask)
        ignored = None if moving else session.ignored(step)
        if step == self._step:  # another tab may have been opened meanwhile
            self.pictures["mask"] = content
            if not moving:
                self.pictures["ignored"] = b"" if ignored is None else drawing.hatching(ignored)

    def _mask_file(self, mask: Tensor) -> bytes:
        """A mask as it is to be shown: in a colour, or in black and white."""
        if self._show_mask.value and self._is_plain.value:
            return drawing.lossless(mask)
        return drawing.mask_picture(mask, drawing.contrasting_tint(self._edited, mask))

    def show_layers(self) -> None:
        """Show what :meth:`lay_over` has computed."""
        self.draw_strokes()
        self.draw_mask()

    def _follow_view(self) -> None:
        """Show the mask as it is asked for."""
        self._is_plain.set_visibility(bool(self._show_mask.value))
        self.draw_mask()
        self._lay()

    def take(self, edited: Tensor) -> None:
        """Take the edited picture (1, C, h, w), in [0, 1], that is shown next."""
        self._edited = edited
        self.pictures["after"] = drawing.picture(edited)
        self.pictures["clipped"] = drawing.clipped_picture(edited) if self._show_clipped.value else b""
        self.histogram, self.clipped = drawing.histogram_svg(edited), drawing.clipped_shares(edited)

    def show(self) -> None:
        """Show the picture that was computed."""
        self._show("after", self._photo)
        self._draw_clipped()

    def draw_mask(self, *, moving: bool = False) -> None:
        """Show the mask, except while a slider is moving; for a second, if it is new and not to be kept in sight."""
        mask, keep = self.pictures.get("mask"), bool(self._show_mask.value)
        new = mask != self._mask_shown
        passing = self._step in BRUSHES and EDITS[self._step].regional is not None  # shows for a moment after a stroke
        if not mask or moving or not (keep or passing):
            self._hide_mask()
            self._mask_shown = mask if not moving else self._mask_shown
        elif keep or new:
            self._mask_shown = mask
            self._flashes += 1
            # An animation begins again if its name changes.
            self._mask.classes(remove="flash-0 flash-1", add="" if keep else f"flash-{self._flashes % 2}")
            self._show("mask", self._mask)
            self._mask.set_visibility(True)
        elif not {"flash-0", "flash-1"}.intersection(self._mask.classes):  # it was kept in sight
            self._hide_mask()

    def _hide_mask(self) -> None:
        self._mask.classes(remove="flash-0 flash-1")
        self._mask.set_visibility(False)

    def _draw_clipped(self) -> None:
        """Show what is clipped, if it is asked for."""
        wanted = bool(self._show_clipped.value) and self._session is not None
        if wanted and not self.pictures.get("clipped"):
            self.pictures["clipped"] = drawing.clipped_picture(self._edited)
        if wanted:
            self._show("clipped", self._clipped)
        self._clipped.set_visibility(wanted)

    def draw_strokes(self) -> None:
        """Show the strokes of the step and the one being drawn, unless strokes are hidden."""
        if self._session is None:
            return
        strokes: tuple[Mark, ...] = ()
        if self._show_strokes.value:
            strokes = self._session.step_in_view(self._step).strokes if self._step in BRUSHES else ()
            if self._line:
                height, width = self._preview_size
                strokes += (self._brush.mark(self._step, [(x / width, y / height) for x, y in self._line]),)
        self._photo.set_content(drawing.strokes_svg(strokes, self._preview_size, keeps=drawing.keeps(self._step)))
        is_hatched = bool(strokes and self.pictures.get("ignored"))
        if is_hatched:
            self._show("ignored", self._ignored)
        self._ignored.set_visibility(is_hatched)

    def _pointer(self, kind: str, x: float, y: float) -> None:
        """Begin, continue or end a stroke, or choose a point."""
        if self.pick is not None and kind == "pointerdown":
            pick = self.pick
            self.await_click(None)
            pick(x, y)
            return
        if self._step not in BRUSHES or self._session is None:
            return
        if kind == "pointerdown":
            self._line = [(x, y)]
        elif not self._line:
            return
        elif kind == "pointermove":
            self._line.append((x, y))
        else:
            line, self._line = self._line, []
            shape = self._brush.drags(self._step)
            if shape is not None:
                sides = [abs(a - b) for a, b in zip(line[0], line[-1], strict=True)]
                if (max if shape == "linear" else min)(sides) >= LEAST_SIDE:
                    ends = line[0], line[-1], self._brush.paint(self._step), shape
                    self._draw(self._step, partial(self._session.add_box, self._step, *ends))
            else:
                stroke = line, self._brush.radius[self._step], self._brush.paint(self._step)
                self._draw(self._step, partial(self._session.add_stroke, self._step, *stroke))
        self.draw_strokes()

    def drop_stroke(self) -> None:
        """Forget the stroke that is being drawn."""
        self._line = []
        self.draw_strokes()

    def _address(self, kind: str) -> str:
        """A new address of a picture."""
        self._frame += 1
        return f"/picture/{self._token}/{kind}?{self._frame}"

    def _show(self, kind: str, element: ui.element) -> None:
        address = self._address(kind)
        if isinstance(element, ui.interactive_image):
            element.set_source(address)
        else:
            element.props(f'src="{address}"')


def _build_zoom() -> None:
    """Buttons for what ``static/closeup.js`` does."""
    with ui.element("div").classes("zoom").props('role="group" aria-label="Zoom"'):
        _zoom_button("Zoom out", "remove", "The minus key, or the wheel", "step(-1)")
        ui.label("").classes("zoom-level").props('aria-live="polite"')
        _zoom_button("Zoom in", "add", "The plus key, or the wheel", "step(1)")
        _zoom_button("Fit", "fit_screen", "The whole photograph; the key 0", "fit()")
        _zoom_button(
            "Full size", "crop_free", "One pixel of the photograph for each of the screen; the key 1", "full()"
        )
        hand = _zoom_button(
            "Move",
            "pan_tool",
            "Drag the photograph in place of the brush; also the space bar, the middle "
            "button, two fingers and the arrow keys",
            "hand()",
        )
        hand.classes("grab").props('aria-pressed="false"')


def _zoom_button(label: str, icon: str, tip: str, action: str) -> ui.button:
    button = ui.button(icon=icon).props(f'flat dense color=white aria-label="{label}"').tooltip(tip)
    return button.on("click", js_handler=f"() => closeup.{action}")
