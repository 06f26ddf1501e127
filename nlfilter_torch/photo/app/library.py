"""The photographs that are open in the editor: every tab that shows one of them shares its session."""

import hashlib
from pathlib import Path
from threading import Lock
from weakref import WeakValueDictionary

from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.sidecar import ENDING, Sidecar

GONE = "open the photograph again: this page lost it, but its edit is kept"


class Library:
    """Sessions by the address in the location of their page, which survives a reload.

    Files are saved in ``folder``; edits are kept beside the photographs in ``photographs``, by default the same folder.
    """

    def __init__(self, folder: Path, photographs: Path | None = None) -> None:
        self.folder = folder
        self.photographs = folder if photographs is None else photographs
        self._sessions: WeakValueDictionary[tuple[str, float], Session] = WeakValueDictionary()
        self._latest: Session | None = None  # kept alive while a page is reloaded and nobody shows its photograph
        self._lock = Lock()

    def open(self, path: Path) -> Session:
        """The session of a file; raises as :class:`Session`."""
        version = path.stat().st_mtime if path.exists() else 0.0
        inside = path.parent.resolve() == self.photographs.resolve()
        return self._session(path, path.name, path, path.name if inside else str(path.resolve()), version)

    def open_upload(self, copy: Path, name: str) -> Session:
        """The session of a file that the browser sent, or of the file of that name in the folder if it is the same.

        Raises:
            ValueError, OSError, MemoryError: as :class:`Session`.
        """
        name = Path(name).name
        original = self.photographs / name
        if name and original.is_file() and _same(original, copy):
            return self.open(original)
        return self._session(copy, name, None, _digest(copy)[:16], 0.0)

    def reopen(self, address: str) -> Session:
        """The session of the address of an earlier page; raises ValueError if its photograph is gone."""
        with self._lock:
            known = [session for (other, _), session in self._sessions.items() if other == address]
        if known:
            return known[-1]
        path = self.photographs / Path(address).name
        # Only a photograph that was edited here: an address must not open other files.
        if Path(address).name == address and path.is_file() and path.with_name(path.name + ENDING).exists():
            return self.open(path)
        raise ValueError(GONE)

    def _session(self, path: Path, name: str, original: Path | None, address: str, version: float) -> Session:
        with self._lock:
            session = self._sessions.get((address, version))
        if session is None:
            session = Session(self.folder, path, name)
            session.address = address
            session.keep_in(Sidecar.of(original, name, _digest(path)))
        else:
            session.restore()  # another program may have changed the file, or a person removed it to begin anew
        with self._lock:
            session = self._sessions.setdefault((address, version), session)
            self._latest = session
        return session


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _same(a: Path, b: Path) -> bool:
    return a.stat().st_size == b.stat().st_size and _digest(a) == _digest(b)
