"""An edit with its settings, as functions, commands, files and the editor use it."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

from torch import Tensor

from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.declared.declaration import Arguments, Edit
from nlfilter_torch.photo.declared.strokes import ScribbleRole
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.pixels import Fitted, M, WorkingRange
from nlfilter_torch.photo.picture.source import Source

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
    """An edit with its settings; the fields are arguments of its function, and the options of its filter.

    Attributes:
        options: of the filter, as the function takes them; see :meth:`filter_options`.
        declared: its name, parameters and scribbles.
        reports_change: whether the command reports how much it changed the pixels, see :meth:`summary`.
        relative: whether the edit sees a picture relative to the range that it uses, see :class:`WorkingRange`.
        gives_picture: whether the result is an edited picture; otherwise it is a mask.
        image_channels: number of channels that an image must have for the function of the edit; None is any.
        filtering: options of the filter that are not parameters of the edit, and differ from the usual ones.
    """

    options: FilterOptions
    declared: ClassVar[Edit]
    reports_change: ClassVar[bool] = False
    relative: ClassVar[bool] = False
    gives_picture: ClassVar[bool] = True
    image_channels: ClassVar[int | None] = None
    filtering: ClassVar[FilterOptions] = FilterOptions()

    @classmethod
    def of(cls, arguments: Arguments) -> Self:
        """Create the edit from arguments of its function: its ``locals()``, or :meth:`Step.arguments`."""
        own = {setting.name: arguments[setting.name] for setting in fields(cls) if setting.name in arguments}
        return cls(options=cls.filtering.updated(arguments), **own)

    def filter_options(self, size: tuple[int, int], *, fewer_landmarks: bool = False) -> FilterOptions:
        """Options of the filter of a picture (H, W), at which distances in shares of the picture are known.

        With ``fewer_landmarks``, a picture with fewer pixels than landmarks has as many landmarks as pixels; without,
        there is a warning when the operator is built.
        """
        count = min(self.options.num_landmarks, math.prod(size)) if fewer_landmarks else self.options.num_landmarks
        distance = self.declared["spatial_bandwidth"].distance(self.options.spatial_bandwidth, size)
        return replace(self.options, spatial_bandwidth=distance, num_landmarks=count)

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

    def standard_error(self, image: Tensor, weights: Tensor | None) -> Tensor:
        """Standard errors (B, C, H, W) of the edited pixels of an image in memory, for those that declare them."""
        raise NotImplementedError(f"{self.declared.name} estimates no errors")

    def selection(self) -> "PhotoEdit | None":
        """The edit that computes the mask of the scribbled objects; None if every pixel is changed."""
        return None

    def marks(self, drawn: Drawn[M]) -> Drawn[M]:
        """The scribbles under the names that :meth:`selection` takes; the last plane of colours is their mask."""
        masks = dict[str, M]()
        for scribble in self.declared.scribbles:
            coloured = drawn.colours if scribble.kind == "colours" and scribble.role == "object" else None
            mask = drawn.masks.get(scribble.argument, coloured)
            if mask is not None:
                masks[MARKS[scribble.role]] = mask
        return Drawn(masks, box=drawn.box)
