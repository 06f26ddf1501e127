"""Registration of a photograph before an edit with one after it."""

import math

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.picture.resizing import resize

SAME_SHAPE = 0.02  # largest difference of log aspect ratios at which an edited picture counts as resized
MIN_CORRELATION = 0.6  # correlation required between a crop and its position
SEARCH_SIDE = 400  # short side in pixels of the reduced picture in which a crop is searched for first
MAX_SHIFT = 0.1  # largest shift, as a share of the short side
PLAIN = 2.5 / 255  # largest difference of colours within a frame, after lossy compression too


def align(before: Tensor, after: Tensor, name: str, edited: str) -> tuple[Tensor, Tensor, str]:
    """Return the common part of two photographs (1, C, H, W), before and after an edit, at the same size.

    An edited picture of another size is resized if it has the same aspect ratio, or searched for as a crop of the
    original; a shift of a few pixels is undone. A frame of one colour around it is cut off if the photograph is
    complete without it.

    Returns:
        Both pictures, and a description of the changes for the user, empty if there are none.

    Raises:
        ValueError: if the edited picture is not found in the original. ``name`` and ``edited`` are the names of the two
            in the message.
    """
    size, other = before.shape[-2:], after.shape[-2:]
    edges = frame(before[0], after[0])
    framed = f"{edited} has a frame of one colour, which is left out" if any(edges) else ""
    inside = _inside(after, edges)
    if size == other:
        if min(edges) > 0:
            enlarged = resize(inside, (size[0], size[1])).clamp(0, 1)
            kept = _inside(before, edges)
            if _correlation(_grey(before), _grey(enlarged)) > _correlation(_grey(kept), _grey(inside)):
                return before, enlarged, f"{framed}; the picture in it is enlarged to {size[1]}x{size[0]}"
        down, right = (0, 0) if framed else _shift(before, after)
        if (down, right) == (0, 0):
            return before, after, framed
        done = f"{edited} is shifted by {down} pixels down and {right} to the right"
        return *_overlap(before, after, down, right), done
    if min(edges) > 0:
        first, second, done = align(before, inside, name, edited)
        return first, second, f"{framed}; {done}" if done else framed
    ratio = (other[1] / other[0]) / (size[1] / size[0])
    resized = resize(after, (size[0], size[1])).clamp(0, 1) if abs(math.log(ratio)) < SAME_SHAPE else None
    place, likeness = (0, 0), -1.0
    if other[0] <= size[0] and other[1] <= size[1]:
        place, likeness = _place(before, after)
    if resized is not None and _correlation(_grey(before), _grey(resized)) >= likeness:
        return before, resized, f"{edited} is resized from {other[1]}x{other[0]} to {size[1]}x{size[0]}"
    if likeness < MIN_CORRELATION:
        raise ValueError(
            f"{edited} must have the size of {name}, {size[1]}x{size[0]}, or be a resized copy or a crop of it, "
            f"got {other[1]}x{other[0]}; crop both to the same area"
        )
    part = before[..., place[0] : place[0] + other[0], place[1] : place[1] + other[1]]
    return part, after, f"{edited} is a crop of {name} from row {place[0]}, column {place[1]}"


def frame(before: Tensor, after: Tensor) -> tuple[int, int, int, int]:
    """Widths in pixels of a frame of one colour around an edited picture (C, H, W): above, below, left and right.

    0 along edges where the photograph before the edit is of one colour as well.
    """
    edges, old = _plain_edges(after), _plain_edges(before)
    if edges[0] + edges[1] >= after.shape[-2] or edges[2] + edges[3] >= after.shape[-1]:
        return 0, 0, 0, 0
    above, below, left, right = (width if other < width else 0 for width, other in zip(edges, old, strict=True))
    return above, below, left, right


def inside_frame(before: Tensor, after: Tensor) -> Tensor:
    """Which pixels (H, W) of an edited picture (C, H, W) are not in a :func:`frame` around it."""
    found = torch.ones(after.shape[-2:], dtype=torch.bool, device=after.device)
    height, width = found.shape
    above, below, left, right = frame(before, after)
    found[:above], found[height - below :], found[:, :left], found[:, width - right :] = False, False, False, False
    return found


def _plain_edges(image: Tensor) -> tuple[int, int, int, int]:
    """How many lines along each edge of a picture (C, H, W) have the colour of its first pixel."""
    plain = ((image - image[:, :1, :1]).abs() <= PLAIN).all(0)
    rows, columns = plain.all(1), plain.all(0)
    lines = (rows, rows.flip(0), columns, columns.flip(0))
    above, below, left, right = (int(line.long().cumprod(0).sum()) for line in lines)
    return above, below, left, right


def _inside(image: Tensor, edges: tuple[int, int, int, int]) -> Tensor:
    """A picture (..., H, W) without a frame of these widths."""
    above, below, left, right = edges
    return image[..., above : image.shape[-2] - below, left : image.shape[-1] - right]


def _grey(image: Tensor) -> Tensor:
    """Luminance (H, W)."""
    return reduce_channels(image, "luminance").mean((0, 1)).double()


def _correlation(first: Tensor, second: Tensor) -> float:
    pair = torch.stack([first.flatten(), second.flatten()])
    found = float(pair.corrcoef()[0, 1])
    return found if math.isfinite(found) else 0.0


def _shift(before: Tensor, after: Tensor) -> tuple[int, int]:
    """Estimate the shift (down, right) of a picture in pixels; 0 unless undoing it increases the correlation."""
    from skimage.registration import phase_cross_correlation

    first, second = _grey(before), _grey(after)
    found = phase_cross_correlation(second.numpy(), first.numpy(), normalization=None)[0]
    down, right = (round(float(shift)) for shift in found)
    limit = MAX_SHIFT * min(first.shape)
    if (down, right) == (0, 0) or max(abs(down), abs(right)) > limit:
        return 0, 0
    likeness = _correlation(*_overlap(first, second, down, right))
    return (down, right) if likeness > _correlation(first, second) + 0.01 else (0, 0)


def _overlap(first: Tensor, second: Tensor, down: int, right: int) -> tuple[Tensor, Tensor]:
    """Crop two pictures, the second shifted by ``down`` and ``right`` pixels, to their common part (..., h, w)."""
    height, width = first.shape[-2:]
    return (
        first[..., max(0, -down) : height - max(0, down), max(0, -right) : width - max(0, right)],
        second[..., max(0, down) : height - max(0, -down), max(0, right) : width - max(0, -right)],
    )


def _place(before: Tensor, after: Tensor) -> tuple[tuple[int, int], float]:
    """Find the position (row, column) of a smaller picture in a larger one, and the correlation there."""
    from skimage.feature import match_template

    whole, part = _grey(before), _grey(after)
    scale = max(1.0, min(whole.shape) / SEARCH_SIDE)
    small, piece = whole, part
    if scale > 1:
        small, piece = (
            resize(grey[None, None], (max(1, round(grey.shape[0] / scale)), max(1, round(grey.shape[1] / scale))))[0, 0]
            for grey in (whole, part)
        )
    if min(piece.shape) < 4 or float(piece.std()) == 0:
        return (0, 0), -1.0
    found = match_template(small.numpy(), piece.numpy()[: small.shape[0], : small.shape[1]])
    row, column = (int(i) for i in np.unravel_index(int(found.argmax()), found.shape))
    if scale == 1:
        return (row, column), float(found.max())
    margin = math.ceil(2 * scale)  # the position is accurate to a few pixels; search again around it
    top, left = (
        min(max(0, round(place * scale) - margin), room)
        for place, room in zip(
            (row, column), (whole.shape[0] - part.shape[0], whole.shape[1] - part.shape[1]), strict=True
        )
    )
    near = whole[top : top + part.shape[0] + 2 * margin, left : left + part.shape[1] + 2 * margin]
    found = match_template(near.numpy(), part.numpy())
    down, right = (int(i) for i in np.unravel_index(int(found.argmax()), found.shape))
    return (top + down, left + right), float(found.max())
