"""What the page says of its work in threads, and what it asks for: names, confirmations, files of the browser."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, TypeVar, TypeVarTuple

from nicegui import background_tasks, events, ui

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app.controls import SteadySlider

Result = TypeVar("Result")
Arguments = TypeVarTuple("Arguments")
EXPECTED = (ValueError, OSError, MemoryError)  # for unusable files and values; the message says why
PATIENCE = 0.3  # seconds until the page shows that it is working
BETWEEN_TEXTS = 0.5  # seconds between two texts of the progress
LASTING = 10.0  # seconds that an error is shown
QUALITY, LEAST_QUALITY = 95, 50  # of JPEG files; below, the damage is visible
SHORTEST = 16  # pixels of the longest side
PHOTOGRAPHS = "PNG, JPEG, TIFF, WebP, AVIF or HEIC"
EXISTS = "A file of that name is there already."


class Tasks:
    """The work of the page that is being built, with a sign that it goes on, in the open element.

    Attributes:
        sign: the sign, which can be moved to another element.
    """

    def __init__(self) -> None:
        self._client = ui.context.client
        self._error: ui.notification | None = None
        self._going_on: dict[object, str] = {}  # what is shown, by who does it
        with ui.row().classes("items-center gap-2 no-wrap working").props("role=status") as self.sign:
            ui.spinner(size="20px", color="white")
            self._doing = ui.label("")
        self.sign.set_visibility(False)

    def say(self, who: object, doing: str = "") -> None:
        """Show what goes on at once, until the same object says that nothing does."""
        if doing:
            self._going_on[who] = doing
        else:
            self._going_on.pop(who, None)
        if self._going_on:
            self._doing.set_text(next(reversed(self._going_on.values())))
        self.sign.set_visibility(bool(self._going_on))

    def start(self, work: Awaitable[None]) -> None:
        """Run a task in the background, and report its failure."""
        background_tasks.create(self._reported(work))

    async def _reported(self, work: Awaitable[None]) -> None:
        try:
            await work
        except EXPECTED as error:
            self.show_error(str(error))
        except Exception:
            self.show_error("this failed, and it is not your fault; the terminal that runs the editor shows more")
            raise  # for the log

    async def run(
        self,
        doing: str,
        work: Callable[[*Arguments], Result],
        *arguments: *Arguments,
        progress: Progress | None = None,
    ) -> Result:
        """Run something in a thread; the page shows ``doing`` if it takes long, and its progress."""
        task = asyncio.ensure_future(asyncio.to_thread(work, *arguments))
        done, _ = await asyncio.wait({task}, timeout=PATIENCE)
        if not done:
            self.say(task, f"{doing}\u2026")
            while not task.done():
                await asyncio.wait({task}, timeout=BETWEEN_TEXTS)
                known = "" if progress is None else str(progress)
                self.say(task, f"{doing}: {known}" if known else f"{doing}\u2026")
            self.say(task)
        return await task

    def show_error(self, sentence: str) -> None:
        """Show a sentence until something succeeds, or for some seconds."""
        self.clear_error()
        if not self._client.is_deleted:
            with self._client:
                self._error = ui.notification(
                    sentence, type="negative", position="bottom", timeout=LASTING, close_button="OK", multi_line=True
                )

    def clear_error(self) -> None:
        """Remove the error that is shown, if there is one."""
        error, self._error = self._error, None
        if error is not None and not error.is_deleted:
            error.dismiss()


class NameDialog:
    """Asks for a name that passes a check, and whether to replace a file of that name.

    ``check`` returns the file of a name, or raises an error that says why there cannot be one.
    """

    def __init__(self, title: str, name: str, folder: Path, check: Callable[[str], Path]) -> None:
        self._check = check
        with ui.dialog().props(f'aria-label="{title}"') as self._dialog, ui.card().classes("dialog"):
            ui.label(title).classes("text-h6")
            self._name = ui.input("Name", value=name).props("outlined autofocus").classes("w-full")
            self._build_options()
            self._note = ui.label().classes("hint").props("aria-live=polite")
            with ui.row().classes("w-full justify-end"):
                ui.button("Cancel", on_click=lambda: self._dialog.submit(None)).props("flat no-caps")
                self._ok = ui.button("Save").props("unelevated no-caps color=primary")
        self._folder = folder
        self._name.on_value_change(self._follow)
        self._name.on("keydown.enter", self._confirm)
        self._ok.on_click(self._confirm)
        self._follow()

    def _build_options(self) -> None:
        """Build what is asked beside the name."""

    def _trouble(self) -> str | None:
        """What is wrong with what is asked beside the name, as a sentence, or None."""
        return None

    def _follow(self) -> None:
        """Say where the file goes, and whether there is one of that name."""
        self._ok.set_text("Save")
        try:
            exists = self._check(self._name.value).exists()
        except EXPECTED:  # said once the name is complete
            exists = False
        self._note.set_text(EXISTS if exists else f"In {self._folder.resolve()}")

    async def answer(self) -> str | None:
        """The name, or None if there is none; the dialog is gone then."""
        name: str | None = await _answered(self._dialog)
        return name

    def _confirm(self) -> None:
        try:
            exists = self._check(self._name.value).exists()
        except EXPECTED as error:
            self._note.set_text(str(error))
            return
        trouble = self._trouble()
        if trouble is not None:
            self._note.set_text(trouble)
            return
        if exists and self._ok.text != "Replace":
            self._ok.set_text("Replace")
            self._note.set_text(f"{EXISTS} Replace it?")
            return
        self._dialog.submit(self._name.value)


class SaveDialog(NameDialog):
    """Asks for the name of a photograph, and for the options of its file.

    ``side`` is the longest side of the photograph in pixels.
    """

    def __init__(self, title: str, name: str, folder: Path, check: Callable[[str], Path], side: int) -> None:
        self._longest = side
        super().__init__(title, name, folder, check)

    @property
    def options(self) -> tuple[int, int | None]:
        """The quality of a JPEG file, and the longest side in pixels, or None to keep the size."""
        side = self._side.value
        shrinks = side is not None and side < self._longest
        return round(self._quality.value), round(side) if shrinks else None

    def _trouble(self) -> str | None:
        side = self._side.value
        if side is None or SHORTEST <= side <= self._longest:
            return None
        return (
            f"the longest side must be from {SHORTEST} to {self._longest} pixels, got {side:g}; leave it empty to "
            "keep the size"
        )

    def _build_options(self) -> None:
        with ui.row().classes("w-full items-center no-wrap gap-3") as self._lossy:
            label = ui.label().classes("text-no-wrap")
            self._quality = SteadySlider(min=LEAST_QUALITY, max=100, step=1, value=QUALITY)
            label.bind_text_from(self._quality, "value", lambda value: f"JPEG quality {value:.0f}")
            self._quality.props('dense aria-label="JPEG quality"').on_reset(lambda: self._quality.set_value(QUALITY))
        self._side = ui.number("Longest side in pixels", value=self._longest, precision=0)
        self._side.props("outlined dense").classes("w-full").on_value_change(self._follow)

    def _follow(self) -> None:
        super()._follow()
        trouble = self._trouble()
        if trouble is not None:
            self._note.set_text(trouble)
        self._lossy.set_visibility(Path(str(self._name.value).lower()).suffix in (".jpg", ".jpeg"))


class Question:
    """Asks whether to do something."""

    def __init__(self, title: str, text: str, ok: str) -> None:
        with ui.dialog().props(f'aria-label="{title}"') as self._dialog, ui.card().classes("dialog"):
            ui.label(title).classes("text-h6")
            ui.label(text)
            self._build_options()
            with ui.row().classes("w-full justify-end"):
                ui.button("Cancel", on_click=lambda: self._dialog.submit(False)).props("flat no-caps autofocus")
                ui.button(ok, on_click=lambda: self._dialog.submit(True)).props("unelevated no-caps color=primary")

    def _build_options(self) -> None:
        """Build what is asked beside that."""

    async def answer(self) -> bool:
        """Whether to do it; the dialog is gone then."""
        return bool(await _answered(self._dialog))


async def _answered(dialog: ui.dialog) -> Any:
    """What a dialog is closed with; it is gone then."""
    answer = await dialog
    if not dialog.is_deleted:  # a tab that is closed takes its dialogs with it
        dialog.delete()
    return answer


class Upload:
    """A way for the user to choose a file, which is passed to an action; built, invisibly, into the open element.

    Args:
        action: takes the file.
        accept: kinds of files, as the ``accept`` attribute of HTML has them.
        largest: largest size in bytes.
        show_error: takes a sentence for the user.
        several: whether several files may be chosen at once, each of which is passed to the action.
        begin: is called with the names of files that have been chosen, or None.
    """

    def __init__(
        self,
        action: Callable[[events.UploadEventArguments], Awaitable[None]],
        accept: str,
        largest: int,
        show_error: Callable[[str], None],
        *,
        several: bool = False,
        begin: Callable[[list[str]], object] | None = None,
    ) -> None:
        self._largest, self._show_error, self._accept = largest, show_error, accept
        self._upload = ui.upload(multiple=several, auto_upload=True, on_upload=action, max_file_size=largest)
        self._upload.on("finish", lambda: self._upload.run_method("reset"), args=[])
        if begin is not None:
            self._upload.on(
                "added", lambda event: begin(event.args), js_handler="(files) => emit(files.map((file) => file.name))"
            )
        self._upload.on(
            "rejected",
            lambda event: self._refuse(*event.args),
            js_handler="(entries) => page.refuse(entries, emit)",
        )
        self._upload.props(f'accept="{accept}"').classes("hidden")

    @property
    def choosing(self) -> str:
        """JavaScript that lets the user choose a file."""
        return f"() => getElement({self._upload.id}).$refs.qRef.pickFiles()"

    @property
    def dropping(self) -> str:
        """JavaScript after which a photograph that is dropped on the page is taken, and edits by their own upload."""
        return f"page.takeDropped(getElement({self._upload.id}).$refs.qRef)"

    def _refuse(self, reason: str, name: str) -> None:
        """Say why the browser did not send a file, or no other than this one."""
        if reason == "max-file-size":
            size = f"{self._largest / 1e9:g} GB" if self._largest >= 1e9 else f"{self._largest / 1e6:g} MB"
            self._show_error(f"{name} must be at most {size}; make it smaller, or use the command line")
        elif reason == "dialog":
            self._show_error(f"{name} is not opened while a dialog is; close it, and drop the file again")
        elif reason == "several":  # not an error, which would leave once this file is open
            ui.notify(f"Only one edit is loaded at a time: {name}.", position="bottom-left", timeout=6000)
        else:
            self._show_error(f"{name} must be a {_kinds(self._accept)} file; choose another")


def _kinds(accept: str) -> str:
    """What an ``accept`` attribute stands for.

    >>> _kinds(".json,.cube,.png,application/json")
    '.json, .cube or .png'
    """
    if accept.startswith("image/*"):
        return PHOTOGRAPHS
    *endings, last = [kind for kind in accept.split(",") if kind.startswith(".")]
    return f"{', '.join(endings)} or {last}"
