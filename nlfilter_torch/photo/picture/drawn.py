"""Scribbles of an edit, in the form that a source takes, and what rasterises strokes to that form."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from torch import Tensor

from nlfilter_torch.photo.declared.strokes import Stroke

M = TypeVar("M")  # masks and colours of pixels as a source takes them: tensors in memory, rows in tiles
M_co = TypeVar("M_co", covariant=True)  # likewise, of values that are only read

Size = tuple[int, int]  # (H, W)


@dataclass(frozen=True, eq=False)
class Drawn(Generic[M_co]):
    """The scribbles of an edit.

    Attributes:
        masks: by the name of the argument of the edit's function.
        colours: of the scribbles that have colours, RGB; or with their mask as a fourth channel, in place of an entry
            of ``masks``.
        sliders: (K, k+1), a row for each region that has sliders of its own; None if none has.
        outside: sliders (k+1,) outside these regions; None leaves the other pixels unchanged.
    """

    masks: Mapping[str, M_co] = field(default_factory=dict)
    colours: M_co | None = None
    sliders: Tensor | None = None
    outside: Tensor | None = None

    @staticmethod
    def of(masks: Mapping[str, M | None], colours: M | None = None) -> "Drawn[M]":
        """Scribbles of which some may be None, where there are none."""
        return Drawn({name: mask for name, mask in masks.items() if mask is not None}, colours)


class Painter(Protocol[M]):
    """Rasterises strokes to masks and colours as a source takes them."""

    def mask(self, strokes: Sequence[Stroke], size: Size, *, above: Sequence[Stroke] = ()) -> M:
        """The mask of strokes on a picture (H, W), which is 0 where the strokes ``above`` cover them."""

    def colours(self, strokes: Sequence[Stroke], size: Size) -> tuple[M, M | None]:
        """Colours of strokes and their mask, which is None if it is the fourth channel of the colours."""

    def on_mask(self, strokes: Sequence[Stroke], word: str, size: Size) -> M:
        """What strokes of a meaning set on a mask of a picture (H, W), with RGB before it if the meaning has a colour.

        Later strokes of any meaning cover earlier ones.
        """

    def covers(self, marks: M) -> bool:
        """Whether a mask or colours cover a pixel of the picture."""
