"""What the page asks in dialogs."""

from collections.abc import Callable
from pathlib import Path

from nicegui import ui

from nlfilter_torch.photo.app.tasks import EXPECTED


class NameDialog:
    """Asks for a name that passes a check, and whether to replace a file of that name.

    ``check`` returns the file of a name, or raises an error that says why there cannot be one.
    """

    def __init__(self, title: str, name: str, folder: Path, check: Callable[[str], Path]) -> None:
        self._check = check
        with ui.dialog().props(f'aria-label="{title}"') as self._dialog, ui.card().classes("dialog"):
            ui.label(title).classes("text-h6")
            self._name = ui.input("Name", value=name).props("outlined autofocus").classes("w-full")
            self._note = ui.label(f"In {folder.resolve()}").classes("hint")
            with ui.row().classes("w-full justify-end"):
                ui.button("Cancel", on_click=lambda: self._dialog.submit(None)).props("flat no-caps")
                self._ok = ui.button("Save").props("unelevated no-caps color=primary")
        self._name.on_value_change(lambda: self._ok.set_text("Save"))
        self._name.on("keydown.enter", self._confirm)
        self._ok.on_click(self._confirm)

    async def answer(self) -> str | None:
        """The name, or None if there is none; the dialog is gone then."""
        name: str | None = await self._dialog
        if not self._dialog.is_deleted:  # a tab that is closed takes its dialogs with it
            self._dialog.delete()
        return name

    def _confirm(self) -> None:
        try:
            exists = self._check(self._name.value).exists()
        except EXPECTED as error:
            self._note.set_text(str(error))
            return
        if exists and self._ok.text != "Replace":
            self._ok.set_text("Replace")
            self._note.set_text("A file of that name is there already.")
            return
        self._dialog.submit(self._name.value)
