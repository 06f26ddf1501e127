"""The work of a page in threads and in the background, and what the page shows of it: progress and errors."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar, TypeVarTuple

from nicegui import background_tasks, ui

from nlfilter_torch.core.progress import Progress

Result = TypeVar("Result")
Arguments = TypeVarTuple("Arguments")
EXPECTED = (ValueError, OSError, MemoryError)  # for unusable files and values; the message says why
PATIENCE = 0.3  # seconds until the page shows that it is working
BETWEEN_TEXTS = 0.5  # seconds between two texts of the progress
LASTING = 10.0  # seconds that an error is shown


class Tasks:
    """The work of the page that is being built, with a sign that it goes on, in the open element."""

    def __init__(self) -> None:
        self._client = ui.context.client
        self._error: ui.notification | None = None
        with ui.row().classes("items-center gap-2 no-wrap working") as self._working:
            ui.spinner(size="20px", color="white")
            self._doing = ui.label("").classes("hint")
        self._working.set_visibility(False)

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
            self._doing.set_text(f"{doing}\u2026")
            self._working.set_visibility(True)
            while not task.done():
                await asyncio.wait({task}, timeout=BETWEEN_TEXTS)
                known = "" if progress is None else str(progress)
                self._doing.set_text(f"{doing}: {known}" if known else f"{doing}\u2026")
            self._working.set_visibility(False)
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
