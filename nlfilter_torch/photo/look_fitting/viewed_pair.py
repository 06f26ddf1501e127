"""A photograph before and after an edit, at the viewing size: a sample of its pixels, for edits of brightness."""

import torch
from torch import Tensor

from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.look_fitting.alignment import inside_frame
from nlfilter_torch.photo.look_fitting.kept_pixels import latin, squares
from nlfilter_torch.photo.look_fitting.look_sums import means_of_shades, sample
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.seen import range_of
from nlfilter_torch.photo.picture.viewing import viewed_size

# An edit of brightness moves colours along grey, and their chroma in proportion. Shares of a change that must be so,
# and along grey; noise of compression is not.
ALONG_BOTH, ALONG_GREY = 0.6, 0.5
ROUNDING = 0.51 / 255  # of files of 8 bits
CURVE = 0.996  # share that a function of brightness explains from which on an edit counts as a tone curve


class ViewedPair:
    """A photograph before and after an edit, at the viewing size, and a sample of its pixels.

    Args:
        before: (C, H, W) in [0, 1].
        after: likewise.
        viewing_size: in megapixels.
        number: of the pair.

    Attributes:
        image: the photograph before the edit, (1, C, h, w), as edits see it.
        places: row-major indices (P,) of the sample.
        before: (1, C, 1, P), in float64.
        after: likewise.
        weights: (P,), 0 in a frame.
        squares: number of the square of each pixel, (P,).
    """

    def __init__(self, before: Tensor, after: Tensor, viewing_size: float, number: int) -> None:
        dtype = working_dtype(before)
        before, after = before.to(dtype), after.to(dtype)
        inside = inside_frame(before, after).to(dtype)
        size = (before.shape[-2], before.shape[-1])
        small = viewed_size(size, viewing_size)
        if small != size:
            inside = (resize(inside[None, None], small)[0, 0] > 0.99).to(dtype)
        working = range_of(InMemory(before[None]))  # of the whole picture
        self.image, target = (
            resize(planes[None], small) if small != size else planes[None] for planes in (before, after)
        )
        if working is not None:
            self.image, target = working.seen(self.image), working.seen(target)
        places = sample(torch.ones(small))
        self.places = places[::2] if len(places) < small[0] * small[1] else places
        self.before, self.after = (
            planes.flatten(2)[..., None, self.places].double() for planes in (self.image, target.clamp(0, 1))
        )
        self.weights = inside.flatten()[self.places].double()
        self.squares = squares(self.places, small[1])
        self.number = number

    def errors(self, edited: Tensor, step: int = 1) -> Tensor:
        """Weighted errors (C P',) of edited pixels (1, C, 1, P'), each ``step``-th of the sample."""
        return ((edited.clamp(0, 1) - self.after[..., ::step]) * self.weights[::step]).flatten()

    def change(self) -> Tensor:
        """The weighted change (C P,)."""
        return ((self.before - self.after) * self.weights).flatten()

    def is_changed(self) -> bool:
        """Whether a pixel differs by more than the rounding of a file of 8 bits."""
        return bool(((self.before - self.after).abs() > ROUNDING).any())

    def groups(self, alone: bool) -> Tensor:
        """What is left out together, (C P,): the pair or, if it is the only one, a third of its squares."""
        group = latin(self.squares) if alone else torch.full_like(self.squares, self.number)
        return group.repeat(self.before.shape[1])

    def is_of_brightness(self) -> bool:
        """Whether the change can be that of an edit of brightness, which depends on the surroundings of pixels."""
        free = ((self.after > 0) & (self.after < 1)).all(1)[0, 0] & (self.weights > 0)
        before, after = self.before[0, :, 0, free], self.after[0, :, 0, free]
        change = after - before
        power = float(change.square().sum())
        if power == 0:
            return False
        if len(change) == 3:
            grey = change.mean(0)
            chroma = before - before.mean(0)
            direction = chroma / chroma.norm(dim=0).clamp(min=1e-6)
            across = change - grey - (change * direction).sum(0) * direction
            along = 3 * float(grey.square().sum())
            if along < ALONG_GREY * power or 1 - float(across.square().sum()) / power < ALONG_BOTH:
                return False
        return _explained_by_curve(before, change) < CURVE


def _explained_by_curve(before: Tensor, change: Tensor) -> float:
    """Share of the change of luminance (C, P) that a function of luminance explains."""
    grey, moved = (reduce_channels(planes[None, :, None], "luminance")[0, 0, 0] for planes in (before, change))
    return 1 - float((moved - means_of_shades(grey, moved)).square().sum() / moved.square().sum().clamp(min=1e-30))
