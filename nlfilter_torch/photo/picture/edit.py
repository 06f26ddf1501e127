"""An edit with its settings, as functions, commands, files and the editor use it."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal, Self, cast

import torch
from torch import Tensor

from nlfilter_torch.operator.options import Completion, GuideChannels, OperatorOptions, Sampling
from nlfilter_torch.photo.declared.declaration import Arguments, Edit, ScribbleRole
from nlfilter_torch.photo.picture.drawn import Drawn, M
from nlfilter_torch.photo.picture.pixels import Fitted
from nlfilter_torch.photo.picture.source import Source
from nlfilter_torch.photo.picture.working_range import WorkingRange

#: Names of the scribbles of an edit that computes masks, by their roles.
MARKS: dict[ScribbleRole, str] = {
    "object": "scribbles",
    "background": "background",
    "added": "added",
    "removed": "removed",
}


@dataclass(frozen=True)
class Rows:
    """A photograph whose rows are read as they are needed.

    Attributes:
        name: for messages.
        size: (H, W).
        channels: 1 or 3.
        read: reads rows as (1, C, h, W) in [0, 1].
    """

    name: str
    size: tuple[int, int]
    channels: int
    read: Callable[[slice], Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotoEdit(ABC):
    """An edit with its settings; the fields are arguments of its function.

    Attributes:
        declared: its name, parameters and scribbles.
        reports_change: whether the command reports how much it changed the pixels, see :meth:`summary`.
        relative: whether the edit sees a picture relative to the range that it uses, see :class:`WorkingRange`.
        gives_picture: whether the result is an edited picture; otherwise it is a mask.
    """

    declared: ClassVar[Edit]
    reports_change: ClassVar[bool] = False
    relative: ClassVar[bool] = False
    gives_picture: ClassVar[bool] = True

    @classmethod
    def of(cls, arguments: Arguments) -> Self:
        """Create the edit from :meth:`Step.arguments`, which were read from options or JSON."""
        return cls(**arguments)

    @abstractmethod
    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the edit to a picture, with scribbles in the form that the source takes.

        Raises:
            TypeError, ValueError: if a setting or the scribbles do not suit the picture.
        """

    def in_range(self, working: WorkingRange) -> Self:
        """Return the edit with settings in units of the picture converted to those in which it sees the picture."""
        return self

    def check_channels(self, channels: int) -> None:
        """Raise ValueError if the edit cannot be applied to a photograph with that number of channels."""
        return

    def notes(self, rows: Rows) -> Iterator[str]:
        """What a user should know before the edit is applied to a photograph."""
        return iter(())

    def measured(self, source: Source[M]) -> Self:
        """Return the edit with what it would otherwise estimate from the picture."""
        return self

    def summary(self, change: float) -> str:
        """What a command prints after the edit changed the pixels by so many grey levels (RMS)."""
        return f"pixels changed by {change:.2f} grey levels (RMS)"

    def map_of(self, image: Tensor) -> Tensor:
        """The map (B, 3, H, W) in [0, 1] of what the edit estimates, for those that declare one; see :meth:`measured`.

        It depends on at most two pixels around each.
        """
        raise NotImplementedError(f"{self.declared.name} draws no map")

    def selection(self) -> "PhotoEdit | None":
        """The edit that computes the mask of the scribbled objects; None if every pixel is changed."""
        return None

    def marks(self, drawn: Drawn[M]) -> Drawn[M]:
        """The scribbles under the names that :meth:`selection` takes."""
        scribbles = [scribble for scribble in self.declared.scribbles if scribble.argument in drawn.masks]
        return Drawn({MARKS[scribble.role]: drawn.masks[scribble.argument] for scribble in scribbles})


@dataclass(frozen=True, kw_only=True, eq=False)
class FilteredEdit(PhotoEdit):
    """An edit with a filter; the fields are options of :func:`nonlocal_operator`."""

    photometric_bandwidth: float | Tensor | str | None
    spatial_bandwidth: float | Tensor | str | None
    patch_size: int
    num_landmarks: int
    landmarks: Sampling = "kmeans"
    completion: Completion = "diagonal"
    guide_channels: GuideChannels = "luminance"
    generator: torch.Generator | None = None

    def filter_options(self, size: tuple[int, int], *, fewer_landmarks: bool = False) -> OperatorOptions:
        """Options of the filter of a picture (H, W).

        With ``fewer_landmarks``, a picture with fewer pixels than landmarks has as many landmarks as pixels; without,
        there is a warning when the operator is built.
        """
        return OperatorOptions(
            # Other words than "auto", and None, are refused when the operator is built.
            photometric_bandwidth=cast(float | Tensor | Literal["auto"], self.photometric_bandwidth),
            spatial_bandwidth=self.declared["spatial_bandwidth"].distance(self.spatial_bandwidth, size),
            patch_size=self.patch_size,
            num_landmarks=min(self.num_landmarks, math.prod(size)) if fewer_landmarks else self.num_landmarks,
            landmarks=self.landmarks,
            completion=self.completion,
            guide_channels=self.guide_channels,
            generator=self.generator,
        )
