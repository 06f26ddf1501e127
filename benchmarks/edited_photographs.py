"""Free photographs that edits are measured on: scikit-image's, and those of Debian's packages in a folder."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from torch import Tensor

from benchmarks.composites import CHOOSING, REPORTING
from benchmarks.denoiser_training.free_photographs import photographs
from benchmarks.photographs import photograph
from nlfilter_torch.photo.picture.photographs import read_photograph

SHIPPED = "scikit-image"


@dataclass(frozen=True)
class EditedPhotograph:
    """A free photograph.

    Attributes:
        name: unique.
        set: choosing or reporting, or training.
        package: that it is from.
    """

    name: str
    set: str
    package: str

    @property
    def is_shipped(self) -> bool:
        """Whether it ships with scikit-image; others are files in a folder."""
        return self.package == SHIPPED

    def pixels(self, folder: Path | None) -> Tensor:
        """The photograph (1, 3, H, W); the folder is that of :mod:`benchmarks.denoiser_training.free_photographs`."""
        if self.is_shipped:
            return photograph(self.name)[:, :3]
        return read_photograph((folder or Path()) / self.set / f"{self.name}.png").pixels[:, :3].float()


@cache
def edited_photographs() -> dict[str, EditedPhotograph]:
    """All of them, by name."""
    listed = [EditedPhotograph(entry.name, entry.set, entry.package) for entry in photographs()]
    for kind, names in (("choosing", CHOOSING), ("reporting", REPORTING)):
        listed += [EditedPhotograph(name, kind, SHIPPED) for name in names]
    return {entry.name: entry for entry in listed}
