"""The strip of photographs below the picture: thumbnails to switch between them, and an edit for several at once."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol

from nicegui import ui

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app.dialogs import EXPECTED, Question, Tasks
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.shots import Shot, Thumbnail, carried, free_name
from nlfilter_torch.photo.declared.presets import Recipe

GIVING = (
    "The other {} get the light, the colours and the steps of this one, in place of their own. What is painted and the "
    "crop stay those of each photograph. Undo takes it back, photograph by photograph."
)


class Photographs(Protocol):
    """Where photographs are opened; see :class:`~nlfilter_torch.photo.app.library.Library`."""

    folder: Path
    thumbnails: dict[str, Thumbnail]
    copied: Recipe | None

    def session(self, shot: Shot) -> Session:
        """The session of a photograph."""

    def give(self, shot: Shot, recipe: Recipe) -> None:
        """Let a photograph have an edit."""

    def draw(self, shot: Shot) -> bool:
        """Draw its thumbnail, and return whether it has changed."""


class StoppedError(Exception):
    """A person has stopped the work."""


class Stoppable(Progress):
    """Progress of the work on several photographs, which raises StoppedError at the first report after :meth:`stop`."""

    def __init__(self, total: int) -> None:
        super().__init__()
        self.done, self._total, self._stopped = 0, total, False

    def stop(self) -> None:
        """Let the work end."""
        self._stopped = True

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` parts of a stage are done."""
        if self._stopped:
            raise StoppedError
        super().__call__(stage, done, total)

    def __str__(self) -> str:
        """How many photographs are done, and the stage of the one that is being worked on."""
        stage = super().__str__()
        return f"{self.done} of {self._total} done" + (f"; {stage}" if stage else "")


class GivingDialog(Question):
    """Asks whether an edit is given to all other photographs, and whether these are saved."""

    def _build_options(self) -> None:
        self._saves = ui.checkbox("Save them, too, at full size, under new names").props("dense")

    @property
    def saves(self) -> bool:
        """Whether they are to be saved."""
        return bool(self._saves.value)


class Filmstrip:
    """Photographs, built into the open element; it is hidden while there is only one.

    Args:
        library: where they are opened.
        shots: the photographs by their addresses.
        tasks: what runs work in threads.
        shown: returns the session of the photograph that is shown, or None.
        show: is called with the photograph that a person chooses.
        changed: is called after edits of sessions have changed.
        token: part of the addresses of the thumbnails.
    """

    def __init__(
        self,
        library: Photographs,
        shots: dict[str, Shot],
        tasks: Tasks,
        shown: Callable[[], Session | None],
        show: Callable[[Shot], None],
        changed: Callable[[], None],
        token: str,
    ) -> None:
        self._library, self._shots, self._tasks, self._token = library, shots, tasks, token
        self._shown, self._show, self._changed = shown, show, changed
        self._client = ui.context.client
        self._buttons: dict[str, tuple[ui.button, ui.element]] = {}
        self._drawing = self._again = False
        self._giving: Stoppable | None = None
        self._frame = 0
        with ui.element("div").classes("strip") as self._strip:
            with ui.element("div").classes("giving"):
                copy = ui.button("Copy edit", icon="content_copy", on_click=self.copy)
                self._paste = ui.button("Paste edit", icon="content_paste", on_click=self.paste)
                self._all = ui.button("Apply to all", icon="done_all", on_click=self._give_or_stop)
            tips = {
                copy: "Ctrl+Shift+C; the keys N and P show the next and the previous photograph",
                self._paste: "Ctrl+Shift+V",
                self._all: "Give all other photographs this edit",
            }
            for button, tip in tips.items():
                button.props("flat dense no-caps size=sm").props(f'aria-label="{button.text}"').tooltip(tip)
            self._row = ui.element("div").classes("shots").props('role="group" aria-label="Photographs"')
        self.follow()

    def picture(self, kind: str) -> bytes | None:
        """The thumbnail of a kind ``shot-0``, ``shot-1`` and so on."""
        number = kind.removeprefix("shot-")
        addresses = list(self._shots)
        if not kind.startswith("shot-") or not number.isdecimal() or int(number) >= len(addresses):
            return None
        thumbnail = self._library.thumbnails.get(addresses[int(number)])
        return None if thumbnail is None else thumbnail.file

    def follow(self) -> None:
        """Show the photographs that are open, and which of them is shown, with thumbnails as they are edited now."""
        if self._client.is_deleted:
            return
        shots, session = self._shots, self._shown()
        self._strip.set_visibility(len(shots) > 1)
        self._paste.set_enabled(self._library.copied is not None)
        if list(shots) != list(self._buttons):
            self._build()
        for address, (button, _) in self._buttons.items():
            is_shown = session is not None and session.address == address
            button.props('aria-current="true"' if is_shown else "", remove="" if is_shown else "aria-current")
        self._again = len(shots) > 1
        if self._again and not self._drawing:
            self._drawing = True
            self._tasks.start(self._draw())

    def _build(self) -> None:
        self._row.clear()
        self._buttons = {}
        with self._row:
            for number, (address, shot) in enumerate(self._shots.items()):
                button = ui.button(on_click=partial(self._choose, address)).props("flat no-caps").classes("shot")
                button.props["aria-label"] = shot.name
                button.tooltip(shot.name)
                with button:
                    picture = ui.element("img").props('alt=""')
                    self._address(picture, number)
                self._buttons[address] = button, picture

    def _address(self, picture: ui.element, number: int) -> None:
        self._frame += 1
        picture.props(f'src="/picture/{self._token}/shot-{number}?{self._frame}"')

    async def _draw(self) -> None:
        """Draw the thumbnails that are not there yet, or show another edit."""
        try:
            while self._again and not self._client.is_deleted:
                self._again = False
                for address, shot in list(self._shots.items()):
                    try:
                        has_changed = await self._tasks.run("Thumbnails", self._library.draw, shot)
                    except EXPECTED as error:
                        self.drop(address)
                        self._tasks.show_error(str(error).replace(str(shot.path), shot.name))
                        continue
                    shown = self._buttons.get(address)
                    if shown is not None and has_changed:
                        self._address(shown[1], list(self._shots).index(address))
        finally:
            self._drawing = False

    def drop(self, address: str) -> None:
        """Take a photograph that cannot be opened out of the strip."""
        self._shots.pop(address, None)
        self.follow()

    def _choose(self, address: str) -> None:
        session = self._shown()
        if address in self._shots and (session is None or session.address != address):
            self._show(self._shots[address])

    def turn(self, step: int) -> None:
        """Show the next photograph (1), or the one before (-1)."""
        addresses, session = list(self._shots), self._shown()
        if session is not None and session.address in addresses and len(addresses) > 1:
            self._choose(addresses[(addresses.index(session.address) + step) % len(addresses)])

    # Edits

    def copy(self) -> None:
        """Copy the edit of the photograph that is shown."""
        session = self._shown()
        if session is not None:
            self._library.copied = session.recipe
            self._paste.set_enabled(True)
            self._say(f"The edit of {session.name} is copied.")

    def paste(self) -> None:
        """Give the photograph that is shown the edit that was copied."""
        session, copied = self._shown(), self._library.copied
        if session is not None and copied is not None:
            session.load(carried(copied, session.recipe))
            self._changed()
            self._say("The edit is pasted; what is painted and the crop stay those of this photograph.")

    def _say(self, sentence: str) -> None:
        with self._client:
            ui.notify(sentence, position="bottom-left", timeout=5000)

    def _name_giving(self, label: str) -> None:
        self._all.set_text(label)
        self._all.props(f'aria-label="{label}"')

    def _give_or_stop(self) -> None:
        if self._giving is not None:
            self._giving.stop()
        else:
            self._tasks.start(self._ask())

    async def _ask(self) -> None:
        session = self._shown()
        others = [shot for shot in self._shots.values() if session is None or shot.address != session.address]
        if session is None or not others:
            return
        with self._client:
            count = f"{len(others)} photographs" if len(others) > 1 else "photograph"
            dialog = GivingDialog("Apply to all", GIVING.format(count), "Apply to all")
        if await dialog.answer():
            await self.give(session.recipe, others, saves=dialog.saves)

    async def give(self, recipe: Recipe, shots: list[Shot], *, saves: bool) -> None:
        """Give photographs an edit, one after the other, and save each of them if that is asked for."""
        progress, failed = Stoppable(len(shots)), list[str]()
        self._giving = progress
        self._name_giving("Stop")
        try:
            for shot in shots:
                try:
                    await self._tasks.run("Applying", self._give, shot, recipe, saves, progress, progress=progress)
                    progress.done += 1
                except EXPECTED as error:
                    failed.append(f"{shot.name}: {error}")
                self.follow()
        except StoppedError:
            pass  # what is done stays, as the sentence says
        finally:
            self._giving = None
            self._name_giving("Apply to all")
        self._changed()
        done = f"{progress.done} of {len(shots)} have the edit"
        if failed:
            self._tasks.show_error(f"{done}; {failed[0]}")
        elif not self._client.is_deleted:
            self._say(f"{done}, and are saved in {self._library.folder.resolve()}." if saves else f"{done}.")

    def _give(self, shot: Shot, recipe: Recipe, saves: bool, progress: Stoppable) -> Path | None:
        progress(shot.name, 0, 1)
        self._library.draw(shot)  # its size
        self._library.give(shot, recipe)
        if not saves:
            return None
        session = self._library.session(shot)
        return session.save(free_name(session.check_photograph, session.suggested_name()), progress)
