"""Registration of a photograph before an edit with one after it."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import minimize
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.picture.resizing import resize

SAME_SHAPE = 0.02  # largest difference of log aspect ratios at which an edited picture counts as resized
MIN_CORRELATION = 0.6  # correlation required between a crop and its position
SURE = 0.95  # correlation from which on a crop of the same size needs no other search
RESIZED_CORRELATION = 0.85  # required of a crop of another size, as some part of any landscape is like another
BETTER = 0.003  # by which the correlation of a resized crop must be larger
SEARCH_SIDE = 400  # short side in pixels of the reduced picture in which a crop is searched for first
MAX_SHIFT = 0.1  # largest shift, as a share of the short side
PLAIN = 2.5 / 255  # largest difference of colours within a frame, after lossy compression too
# Of the search for a crop that was resized, such as the small picture of a camera beside its RAW file:
FIRST_SIDE, LAST_SIDE = 120, 480  # short side in pixels of the reduced pictures that are compared, first and last
STEP, STEPS = 0.03, 47  # of the logarithm of the size in the first search: from the largest part to a quarter as wide
FIRST_MOVE, LAST_MOVE = 2.0, 0.05  # pixels of the reduced pictures by which a part is moved, first and last
LEAST_CONTRAST = 1e-4  # standard deviation below which a picture is of one brightness
LEAST_PART = 8  # of a part in the first search, in pixels of the reduced pictures


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
    edges = frame(before[0], after[0])
    framed = f"{edited} has a frame of one colour, which is left out" if any(edges) else ""
    if before.shape[-2:] == after.shape[-2:]:
        return _aligned_of_same_size(before, after, edges, framed, edited)
    if min(edges) > 0:
        first, second, done = align(before, _inside(after, edges), name, edited)
        return first, second, f"{framed}; {done}" if done else framed
    return _aligned_of_other_size(before, after, name, edited)


def _aligned_of_same_size(
    before: Tensor, after: Tensor, edges: tuple[int, int, int, int], framed: str, edited: str
) -> tuple[Tensor, Tensor, str]:
    """:func:`align` for pictures of the same size: cut off a frame, or undo a shift."""
    height, width = before.shape[-2:]
    if min(edges) > 0:
        inside, covered = _inside(after, edges), _inside(before, edges)
        enlarged = resize(inside, (height, width)).clamp(0, 1)
        if correlation_of(_grey(before), _grey(enlarged)) > correlation_of(_grey(covered), _grey(inside)):
            return before, enlarged, f"{framed}; the picture in it is enlarged to {width}x{height}"
    down, right = (0, 0) if framed else _shift(before, after)
    if (down, right) == (0, 0):
        return before, after, framed
    done = f"{edited} is shifted by {down} pixels down and {right} to the right"
    return *_overlap(before, after, down, right), done


def _aligned_of_other_size(before: Tensor, after: Tensor, name: str, edited: str) -> tuple[Tensor, Tensor, str]:
    """:func:`align` for an edited picture of another size: resize it, or find it in the original, resized or not."""
    (height, width), other = before.shape[-2:], after.shape[-2:]
    ratio = (other[1] / other[0]) / (width / height)
    resized = resize(after, (height, width)).clamp(0, 1) if abs(math.log(ratio)) < SAME_SHAPE else None
    (row, column), likeness = (0, 0), -1.0
    if other[0] <= height and other[1] <= width:
        (row, column), likeness = _place(before, after)
    whole = -1.0 if resized is None else correlation_of(_grey(before), _grey(resized))
    if (
        likeness < SURE
        and (scaled := _scaled_crop(before, after, max(whole, likeness, RESIZED_CORRELATION))) is not None
    ):
        (top, left), first, second = scaled
        size = f"{second.shape[-1]}x{second.shape[-2]}"
        done = (
            f"{edited} is resized from {other[1]}x{other[0]} to {size}, a crop of {name} from row {top}, column {left}"
        )
        return first, second, done
    if resized is not None and whole >= likeness:
        return before, resized, f"{edited} is resized from {other[1]}x{other[0]} to {width}x{height}"
    if likeness < MIN_CORRELATION:
        raise ValueError(
            f"{edited} must have the size of {name}, {width}x{height}, or be a resized copy or a crop of it, "
            f"got {other[1]}x{other[0]}; crop both to the same area"
        )
    part = before[..., row : row + other[0], column : column + other[1]]
    return part, after, f"{edited} is a crop of {name} from row {row}, column {column}"


def _scaled_crop(before: Tensor, after: Tensor, likeness: float) -> tuple[tuple[int, int], Tensor, Tensor] | None:
    """The place of a resized crop in a photograph, its part there, and the crop at that size.

    None unless their correlation is clearly above ``likeness``.
    """
    place = scaled_crop(_grey(before), _grey(after))
    if place is None:
        return None
    top, left, height, width = place
    part = before[..., top : top + height, left : left + width]
    resized = resize(after, (height, width)).clamp(0, 1)
    return ((top, left), part, resized) if correlation_of(_grey(part), _grey(resized)) > likeness + BETTER else None


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
    """Mask (H, W), bool, of the pixels of an edited picture (C, H, W) that are not in a :func:`frame` around it."""
    mask = torch.ones(after.shape[-2:], dtype=torch.bool, device=after.device)
    height, width = mask.shape
    above, below, left, right = frame(before, after)
    mask[:above], mask[height - below :], mask[:, :left], mask[:, width - right :] = False, False, False, False
    return mask


def explained_share(before: Tensor, after: Tensor, result: Tensor) -> float:
    """Share of the energy of the change that a result explains, 1 at best, without a frame around the picture."""
    shown = inside_frame(before[0], after[0])
    before, after, result = (image[..., shown] for image in (before, after, result))
    rest, change = ((after.double() - image.double()).square().sum() for image in (result, before))
    return 1.0 - float(rest / change)


def _plain_edges(image: Tensor) -> tuple[int, int, int, int]:
    """Number of lines along each edge of a picture (C, H, W) that have the colour of its first pixel."""
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


def _shift(before: Tensor, after: Tensor) -> tuple[int, int]:
    """Estimate the shift (down, right) of a picture in pixels; 0 unless undoing it increases the correlation."""
    from skimage.registration import phase_cross_correlation

    first, second = _grey(before), _grey(after)
    if bool((first == first[0, 0]).all()) or bool((second == second[0, 0]).all()):
        return 0, 0  # of one brightness: every shift is as good
    shifts = phase_cross_correlation(second.numpy(), first.numpy(), normalization=None)[0]
    down, right = (round(float(shift)) for shift in shifts)
    limit = MAX_SHIFT * min(first.shape)
    if (down, right) == (0, 0) or max(abs(down), abs(right)) > limit:
        return 0, 0
    likeness = correlation_of(*_overlap(first, second, down, right))
    return (down, right) if likeness > correlation_of(first, second) + 0.01 else (0, 0)


def _overlap(first: Tensor, second: Tensor, down: int, right: int) -> tuple[Tensor, Tensor]:
    """Crop two pictures, the second shifted by ``down`` and ``right`` pixels, to their common part (..., h, w)."""
    height, width = first.shape[-2:]
    return (
        first[..., max(0, -down) : height - max(0, down), max(0, -right) : width - max(0, right)],
        second[..., max(0, down) : height - max(0, -down), max(0, right) : width - max(0, -right)],
    )


def _place(before: Tensor, after: Tensor) -> tuple[tuple[int, int], float]:
    """Find the position (row, column) of a smaller picture in a larger one, and the correlation there.

    A large picture is reduced for a first search, whose position is accurate to a few pixels; a second search looks
    around it.
    """
    whole, part = _grey(before), _grey(after)
    scale = max(1.0, min(whole.shape) / SEARCH_SIDE)
    small, piece = (reduced_grey(grey, 1 / scale) for grey in (whole, part))
    if min(piece.shape) < 4 or float(piece.std()) == 0:
        return (0, 0), -1.0
    (row, column), correlation = best_match(small, piece[: small.shape[0], : small.shape[1]])
    if scale == 1:
        return (row, column), correlation
    margin = math.ceil(2 * scale)
    top = min(max(0, round(row * scale) - margin), whole.shape[0] - part.shape[0])
    left = min(max(0, round(column * scale) - margin), whole.shape[1] - part.shape[1])
    near = whole[top : top + part.shape[0] + 2 * margin, left : left + part.shape[1] + 2 * margin]
    (down, right), correlation = best_match(near, part)
    return (top + down, left + right), correlation


def scaled_crop(whole: Tensor, part: Tensor) -> tuple[int, int, int, int] | None:
    """The part of luminance (H, W) that other luminance (h, w) shows: row, column, height and width in whole pixels.

    Parts have at least a quarter of the height and width of the largest part of that shape. None if nothing can be
    compared.
    """
    largest = min(whole.shape[0] / part.shape[0], whole.shape[1] / part.shape[1])  # pixels of the whole in one of part
    place = _first_place(whole, part, largest)
    if place is None:
        return None
    for side in (FIRST_SIDE, LAST_SIDE) if 2 * min(whole.shape) > LAST_SIDE else (FIRST_SIDE,):
        place = _refined(whole, part, place, min(1.0, side / min(whole.shape)))
    middle_row, middle_column, pixel = place
    height, width = part.shape[0] * pixel, part.shape[1] * pixel
    top, bottom = _whole_pixels(middle_row, height, whole.shape[0])
    left, right = _whole_pixels(middle_column, width, whole.shape[1])
    return (top, left, bottom - top, right - left) if bottom > top and right > left else None


def _whole_pixels(middle: float, length: float, limit: int) -> tuple[int, int]:
    """The ends in whole pixels, within the picture, of a stretch of that length."""
    return max(0, round(middle - length / 2)), min(limit, round(middle + length / 2))


def _first_place(whole: Tensor, part: Tensor, largest: float) -> tuple[float, float, float] | None:
    """Middle (row, column) of the part and the pixels of the whole in one of its own, by trying sizes."""
    scale = min(1.0, FIRST_SIDE / min(whole.shape))
    small = reduced_grey(whole, scale)
    best, place = -math.inf, None
    for number in range(STEPS):
        pixel = largest * math.exp(-STEP * number)
        piece = reduced_grey(part, scale * pixel)[: small.shape[0], : small.shape[1]]
        if min(piece.shape) < LEAST_PART or float(piece.std()) < LEAST_CONTRAST:
            break
        (row, column), likeness = best_match(small, piece)
        if likeness > best:
            best = likeness
            place = ((row + piece.shape[0] / 2) / scale, (column + piece.shape[1] / 2) / scale, pixel)
    return place


def _refined(
    whole: Tensor, part: Tensor, place: tuple[float, float, float], scale: float
) -> tuple[float, float, float]:
    """A place near another whose correlation is largest in pictures reduced by a factor."""
    shown = reduced_grey(whole, scale), reduced_grey(part, scale * place[2]), place, scale
    moves = np.zeros((4, 3)) + FIRST_MOVE * np.eye(4, 3, -1)  # none, and one along each axis
    options = {"initial_simplex": moves, "xatol": LAST_MOVE, "fatol": BETTER}
    found = minimize(_unlikeness, moves[0], shown, method="Nelder-Mead", options=options)
    return _moved(found.x.tolist(), *shown[1:])


def _moved(
    moves: Sequence[float], part: Tensor, place: tuple[float, float, float], scale: float
) -> tuple[float, float, float]:
    """A place after moves of its middle down and right and of its ends, in pixels of the reduced pictures."""
    down, right, wider = moves
    size = math.exp(wider / (max(part.shape) / 2))
    return place[0] + down / scale, place[1] + right / scale, place[2] * size


def _unlikeness(
    moves: Sequence[float], whole: Tensor, part: Tensor, place: tuple[float, float, float], scale: float
) -> float:
    """The correlation, times -1, of a part (h, w) with the whole (H, W), both reduced, at a place after moves."""
    row, column, pixel = _moved(moves, part, place, scale)
    return -correlation_of(_sampled(whole, scale * row, scale * column, pixel / place[2], part.shape), part)


def _sampled(whole: Tensor, row: float, column: float, step: float, shape: torch.Size) -> Tensor:
    """Luminance (h, w) of a given shape around a place of the whole (H, W), with pixels that many of its own wide."""
    places = []
    for middle, length, limit in zip((row, column), shape, whole.shape, strict=True):
        pixels = middle + step * (torch.arange(length, dtype=whole.dtype) + 0.5 - length / 2)
        places.append(2 * pixels / limit - 1)
    grid = torch.stack(torch.meshgrid(*places, indexing="ij")[::-1], dim=-1)
    return F.grid_sample(whole[None, None], grid[None], padding_mode="border", align_corners=False)[0, 0]


def best_match(whole: Tensor, part: Tensor) -> tuple[tuple[int, int], float]:
    """Position (row, column) of the part in the whole, (H, W) each, and the correlation there."""
    from skimage.feature import match_template

    correlations = match_template(whole.numpy(), part.numpy())
    place = int(correlations.argmax())
    return divmod(place, correlations.shape[1]), float(correlations.flat[place])


def correlation_of(first: Tensor, second: Tensor) -> float:
    """Correlation of two pictures of the same shape; 0 if one of them is of one brightness."""
    return float(torch.stack([first.flatten(), second.flatten()]).corrcoef()[0, 1].nan_to_num())


def reduced_grey(grey: Tensor, scale: float) -> Tensor:
    """Resize luminance (H, W) by a factor."""
    size = (max(1, round(grey.shape[0] * scale)), max(1, round(grey.shape[1] * scale)))
    return grey if size == tuple(grey.shape) else resize(grey[None, None], size)[0, 0]
