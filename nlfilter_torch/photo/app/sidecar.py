"""The file that keeps the edit of an open photograph, in the format that ``apply`` reads.

It is ``photo.jpg.edit.json`` beside ``photo.jpg``, or a file in the user's state folder if the folder of the photograph
is read-only, if the name would be too long, or if the browser sent a photograph that is not in the editor's folder.
"""

import os
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.files.writing import open_beside

ENDING = ".edit.json"
UNREADABLE = ".unreadable"
LONGEST_NAME = 255 - len(UNREADABLE)  # bytes; file systems allow 255


def state_folder() -> Path:
    """The user's folder for edits that cannot be kept beside their photographs."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    else:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "nlfilter-torch"


@dataclass
class Sidecar:
    """The file that keeps an edit.

    Attributes:
        path: path of the file.
        kept: the edit in the file, as of the last read or write.
        trouble: what went wrong in the last read or write, as a sentence, or None.
    """

    path: Path
    kept: Recipe = field(default_factory=Recipe)
    trouble: str | None = None

    @staticmethod
    def of(photograph: Path | None, name: str, digest: str) -> "Sidecar":
        """The sidecar of a photograph file, or, if that is None, of the content with a digest."""
        if photograph is not None:
            beside = photograph.with_name(photograph.name + ENDING)
            short = len(os.fsencode(beside.name)) <= LONGEST_NAME
            if short and (beside.exists() or os.access(photograph.parent, os.W_OK)):
                return Sidecar(beside)
        return Sidecar(state_folder() / f"{digest[:16]}-{os.fsencode(name)[-80:].decode(errors='ignore')}{ENDING}")

    def read(self, size: tuple[int, int]) -> Recipe:
        """The edit in the file, or one that changes nothing; an unreadable file is renamed, so that nothing is lost.

        A file whose crop is outside a photograph (H, W) counts as one.
        """
        self.trouble, self.kept = None, Recipe()
        try:
            recipe = Recipe.from_json(self.path.read_bytes(), str(self.path))
            recipe.check_crop(size, str(self.path))
            self.kept = recipe
        except FileNotFoundError:
            pass
        except OSError as error:
            self.trouble = f"{self.path} cannot be read: {error.strerror or error}; the photograph is shown unedited"
        except ValueError as error:
            self.trouble = f"{error}; the photograph is shown unedited"
            with suppress(OSError):  # in a read-only folder the file stays, and nothing can replace it
                aside = self.path.replace(self.path.with_name(self.path.name + UNREADABLE))
                self.trouble += f", and the file was renamed to {aside.name}"
        return self.kept

    def write(self, recipe: Recipe) -> None:
        """Write an edit, completely or not at all, unless it is kept; one that changes nothing removes the file."""
        if recipe.drawn == self.kept:
            return
        self.trouble = None
        try:
            if recipe.drawn == Recipe():
                self.path.unlink(missing_ok=True)
            else:
                if self.path.parent == state_folder():
                    self.path.parent.mkdir(parents=True, exist_ok=True)
                with open_beside(self.path) as stream:
                    stream.write(recipe.to_json(drawn=True).encode())
            self.kept = recipe.drawn
        except OSError as error:
            reason = str(error) if str(self.path) in str(error) else f"{self.path}: {error}"
            self.trouble = f"the edit cannot be kept ({reason}); use Save edit before you leave"
