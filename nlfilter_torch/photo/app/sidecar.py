"""Where the edit of an open photograph is kept: a file beside it, in the form that ``apply`` takes.

In ``photo.jpg.edit.json`` beside ``photo.jpg``; in a folder of this user's if that one is read-only, if the name would
be too long, or if the browser sent the photograph and no file in the editor's folder is the same.
"""

import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.io.writing import open_beside

ENDING = ".edit.json"
UNREADABLE = ".unreadable"
LONGEST_NAME = 255 - len(UNREADABLE)  # bytes; file systems allow 255


def state_folder() -> Path:
    """The folder for edits that cannot be kept beside their photographs."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    else:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "nlfilter-torch"


@dataclass
class Sidecar:
    """The file that an edit is kept in.

    Attributes:
        path: path of the file.
        trouble: what went wrong when it was read or written last, as a sentence, or None.
    """

    path: Path
    trouble: str | None = None

    @staticmethod
    def of(photograph: Path | None, name: str, digest: str) -> "Sidecar":
        """That of a photograph: a file, or None for one whose content alone is known, by its digest."""
        if photograph is not None:
            beside = photograph.with_name(photograph.name + ENDING)
            short = len(os.fsencode(beside.name)) <= LONGEST_NAME
            if short and (beside.exists() or os.access(photograph.parent, os.W_OK)):
                return Sidecar(beside)
        return Sidecar(state_folder() / f"{digest[:16]}-{os.fsencode(name)[-80:].decode(errors='ignore')}{ENDING}")

    def read(self) -> Recipe | None:
        """The edit that is kept, or None; a file that cannot be read is renamed, so that nothing in it is lost."""
        self.trouble = None
        try:
            return Recipe.from_json(self.path.read_bytes(), str(self.path))
        except FileNotFoundError:
            return None
        except OSError as error:
            self.trouble = f"{self.path} cannot be read: {error.strerror or error}; the photograph is shown unedited"
        except ValueError as error:
            self.trouble = f"{error}; the photograph is shown unedited"
            with suppress(OSError):  # in a read-only folder the file stays, and nothing can replace it
                aside = self.path.replace(self.path.with_name(self.path.name + UNREADABLE))
                self.trouble += f", and the file was renamed to {aside.name}"
        return None

    def write(self, recipe: Recipe) -> None:
        """Keep an edit, completely or not at all; an edit without effect removes the file."""
        self.trouble = None
        try:
            if recipe.drawn == Recipe():
                self.path.unlink(missing_ok=True)
                return
            if self.path.parent == state_folder():
                self.path.parent.mkdir(parents=True, exist_ok=True)
            with open_beside(self.path) as stream:
                stream.write(recipe.to_json(drawn=True).encode())
        except OSError as error:
            reason = str(error) if str(self.path) in str(error) else f"{self.path}: {error}"
            self.trouble = f"the edit cannot be kept ({reason}); use Save edit before you leave"
