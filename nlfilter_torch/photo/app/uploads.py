"""Files that the browser sends to the editor."""

from collections.abc import Awaitable, Callable

from nicegui import events, ui

PHOTOGRAPHS = "PNG, JPEG, TIFF, WebP or AVIF"


class Upload:
    """A way for the user to choose a file, which is passed to an action; built, invisibly, into the open element.

    Args:
        action: takes the file.
        accept: kinds of files, as the ``accept`` attribute of HTML has them.
        largest: largest size in bytes.
        show_error: takes a sentence for the user.
    """

    def __init__(
        self,
        action: Callable[[events.UploadEventArguments], Awaitable[None]],
        accept: str,
        largest: int,
        show_error: Callable[[str], None],
    ) -> None:
        self._largest, self._show_error, self._accept = largest, show_error, accept
        self._upload = ui.upload(auto_upload=True, on_upload=action, max_file_size=largest)
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
            ui.notify(f"Only one file is opened at a time: {name}.", position="bottom-left", timeout=6000)
        else:
            self._show_error(f"{name} must be a {_kinds(self._accept)} file; choose another")


def _kinds(accept: str) -> str:
    """What an ``accept`` attribute stands for.

    >>> _kinds(".json,.cube,.png,application/json")
    '.json, .cube or .png'
    """
    if accept == "image/*":
        return PHOTOGRAPHS
    *endings, last = [kind for kind in accept.split(",") if kind.startswith(".")]
    return f"{', '.join(endings)} or {last}"
