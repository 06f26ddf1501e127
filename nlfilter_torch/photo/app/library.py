"""The photographs that are open in the editor: every tab that shows one of them shares its session."""

import shutil
import tempfile
import weakref
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread
from weakref import WeakValueDictionary

from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.session import History, Session
from nlfilter_torch.photo.app.shots import Shot, Thumbnail, carried, digest_of
from nlfilter_torch.photo.app.sidecar import ENDING
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.edits.recipe import apply_recipe

GONE = "open the photograph again: this page lost it, but its edit is kept"


class Library:
    """Sessions by the address in the location of their page, which survives a reload.

    Files are saved in ``folder``; edits are kept beside the photographs in ``photographs``, by default the same folder.
    Of photographs that no page shows, only the one shown last is kept in memory.

    Attributes:
        rolls: the photographs of the strips of pages by their addresses, in the order in which they were opened.
        thumbnails: of these, by their addresses.
        copied: the edit that was copied last, or None.
    """

    def __init__(self, folder: Path, photographs: Path | None = None) -> None:
        self.folder = folder
        self.photographs = folder if photographs is None else photographs
        self.rolls: dict[str, dict[str, Shot]] = {}
        self.thumbnails: dict[str, Thumbnail] = {}
        self.copied: Recipe | None = None
        self._sessions: WeakValueDictionary[tuple[str, float], Session] = WeakValueDictionary()
        self._shots: dict[str, Shot] = {}  # all that were opened, by their addresses
        self._histories: dict[tuple[str, float], History] = {}
        self._latest: Session | None = None  # kept alive while a page is reloaded and nobody shows its photograph
        self._lock, self._opening = Lock(), Lock()  # photographs are decoded one after the other
        self._copies: Path | None = None  # the folder of files that the browser sent

    @staticmethod
    def opening(folder: Path, images: Sequence[Path]) -> "Library":
        """The library of a folder, which begins to open the first image, if any, for the page that will ask for it.

        Only :meth:`open` says what is wrong with that.
        """
        if not images:
            return Library(folder)
        library = Library(folder, images[0].parent)
        Thread(target=library._open_ahead, args=(images[0],), daemon=True).start()
        return library

    def _open_ahead(self, image: Path) -> None:
        with suppress(Exception):
            self.open(image)

    def open(self, path: Path) -> Session:
        """The session of a file; raises as :class:`Session`."""
        return self.session(self.shot(path))

    def shot(self, path: Path) -> Shot:
        """The photograph of a file."""
        version = path.stat().st_mtime if path.exists() else 0.0
        inside = path.parent.resolve() == self.photographs.resolve()
        return Shot(path, path.name, path, path.name if inside else str(path.resolve()), version)

    def open_upload(self, copy: Path, name: str) -> Session:
        """The session of :meth:`shot_of_upload`; raises as :class:`Session`."""
        return self.session(self.shot_of_upload(copy, name))

    def shot_of_upload(self, copy: Path, name: str) -> Shot:
        """The photograph that the browser sent, which is kept, or that of its name in the folder if it is the same."""
        name = Path(name).name
        original = self.photographs / name
        if name and original.is_file() and _same(original, copy):
            return self.shot(original)
        digest = digest_of(copy)[:16]
        with self._lock:
            if self._copies is None:
                self._copies = Path(tempfile.mkdtemp(prefix="nlfilter-torch-"))
                weakref.finalize(self, shutil.rmtree, self._copies, ignore_errors=True)
            kept = self._copies / digest
            if not kept.exists():
                shutil.copyfile(copy, kept)
        return Shot(kept, name, None, digest, 0.0)

    def reopen(self, address: str) -> Session:
        """The session of the address of an earlier page; raises ValueError if its photograph is gone."""
        with self._lock:
            known = [session for (other, _), session in self._sessions.items() if other == address]
            shot = self._shots.get(address)
        if known:
            return known[-1]
        if shot is not None:
            return self.session(shot)
        path = self.photographs / Path(address).name
        # Only a photograph that was edited here: an address must not open other files.
        if Path(address).name == address and path.is_file() and path.with_name(path.name + ENDING).exists():
            return self.open(path)
        raise ValueError(GONE)

    def session(self, shot: Shot) -> Session:
        """The session of a photograph.

        Raises:
            ValueError, OSError, MemoryError: as :class:`Session`.
        """
        key = shot.address, shot.version
        with self._opening:
            session = self._known(shot)
            if session is None:
                self._latest = None  # its memory is needed
                session = Session(self.folder, shot.path, shot.name)
                session.address = shot.address
                session.history = self._histories.setdefault(key, session.history)
                session.keep_in(shot.sidecar)
            else:
                session.restore()  # another program may have changed the file, or a person removed it to begin anew
            with self._lock:
                self._sessions[key] = self._latest = session
                self._shots[shot.address] = shot
        return session

    def shot_of(self, session: Session) -> Shot:
        """The photograph of a session."""
        with self._lock:
            return self._shots[session.address]

    def _known(self, shot: Shot) -> Session | None:
        with self._lock:
            return self._sessions.get((shot.address, shot.version))

    def recipe(self, shot: Shot) -> Recipe:
        """The edit of a photograph whose thumbnail is there, whether it is open or not."""
        session = self._known(shot)
        return shot.sidecar.read(self.thumbnails[shot.address].size) if session is None else session.recipe

    def give(self, shot: Shot, recipe: Recipe) -> None:
        """Let a photograph whose thumbnail is there have an edit, which Undo takes back.

        Raises:
            OSError: if the edit cannot be kept.
        """
        session = self._known(shot)
        if session is not None:
            session.load(carried(recipe, session.recipe))
            return
        sidecar = shot.sidecar
        before = sidecar.read(self.thumbnails[shot.address].size)
        self._histories.setdefault((shot.address, shot.version), History()).add(before)
        sidecar.write(carried(recipe, before))
        if sidecar.trouble is not None:
            raise OSError(sidecar.trouble)

    def draw(self, shot: Shot) -> bool:
        """Draw the thumbnail of a photograph as it is edited now, and return whether it has changed.

        Raises:
            ValueError, OSError, MemoryError: if it cannot be read.
        """
        if shot.address not in self.thumbnails:
            self.thumbnails[shot.address] = Thumbnail.of(shot)
        thumbnail, recipe = self.thumbnails[shot.address], self.recipe(shot)
        if thumbnail.recipe is not None and thumbnail.recipe.effect == recipe.effect:
            return False
        thumbnail.file = drawing.picture(apply_recipe(recipe, thumbnail.pixels).clamp(0, 1))
        thumbnail.recipe = recipe
        return True


def _same(a: Path, b: Path) -> bool:
    return a.stat().st_size == b.stat().st_size and digest_of(a) == digest_of(b)
