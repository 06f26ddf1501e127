"""The part of a photograph that another picture of it shows at another size.

The small picture of a camera beside its RAW file is such a part, with borders of a few pixels cut off, and so is a
crop that was reduced for the web.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.photo.picture.resizing import resize

FIRST_SIDE, LAST_SIDE = 120, 480  # short side in pixels of the reduced pictures that are compared, first and last
STEP, STEPS = 0.03, 47  # of the logarithm of the size in the first search: from the largest part to a quarter as wide
FIRST_MOVE, LAST_MOVE = 2.0, 0.05  # pixels of the reduced pictures by which a part is moved, first and last
LEAST_CONTRAST = 1e-4  # standard deviation below which a picture is of one brightness
LEAST_SIDE = 8  # of a part in the first search, in pixels of the reduced pictures


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
    small = reduced(whole, scale)
    best, place = -math.inf, None
    for number in range(STEPS):
        pixel = largest * math.exp(-STEP * number)
        piece = reduced(part, scale * pixel)[: small.shape[0], : small.shape[1]]
        if min(piece.shape) < LEAST_SIDE or float(piece.std()) < LEAST_CONTRAST:
            break
        (row, column), likeness = best_match(small, piece)
        if likeness > best:
            best = likeness
            place = ((row + piece.shape[0] / 2) / scale, (column + piece.shape[1] / 2) / scale, pixel)
    return place


def _refined(
    whole: Tensor, part: Tensor, place: tuple[float, float, float], scale: float
) -> tuple[float, float, float]:
    """A place whose correlation is largest in pictures reduced by a factor, by a search along the three axes."""
    comparison = Comparison(reduced(whole, scale), reduced(part, scale * place[2]), place, scale)
    moves: tuple[float, ...] = (0.0, 0.0, 0.0)
    best, step = comparison.correlation(moves), FIRST_MOVE
    while step > LAST_MOVE:
        trials = [
            tuple(move + sign * step * (axis == other) for other, move in enumerate(moves))
            for axis in range(3)
            for sign in (-1, 1)
        ]
        correlations = [comparison.correlation(trial) for trial in trials]
        if max(correlations) > best:
            best = max(correlations)
            moves = trials[correlations.index(best)]
        else:
            step /= 2
    return comparison.place_after(moves)


@dataclass(frozen=True)
class Comparison:
    """A part beside the whole at a place that is moved.

    Attributes:
        whole: luminance (H, W), reduced.
        part: luminance (h, w), reduced.
        place: middle row and column of the part, and pixels of the whole in one of its own, before the reduction.
        scale: factor of the reduction.
    """

    whole: Tensor
    part: Tensor
    place: tuple[float, float, float]
    scale: float

    def place_after(self, moves: tuple[float, ...]) -> tuple[float, float, float]:
        """The place after moves of its middle down and right and of its ends, in pixels of the reduced pictures."""
        row, column, pixel = self.place
        down, right, wider = moves
        size = math.exp(wider / (max(self.part.shape) / 2))
        return row + down / self.scale, column + right / self.scale, pixel * size

    def correlation(self, moves: tuple[float, ...]) -> float:
        """Correlation of the part with the whole after moves."""
        row, column, pixel = self.place_after(moves)
        step = pixel / self.place[2]
        shown = _sampled(self.whole, self.scale * row, self.scale * column, step, self.part.shape)
        return correlation_of(shown, self.part)


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


def reduced(grey: Tensor, scale: float) -> Tensor:
    """Resize luminance (H, W) by a factor."""
    size = (max(1, round(grey.shape[0] * scale)), max(1, round(grey.shape[1] * scale)))
    return grey if size == tuple(grey.shape) else resize(grey[None, None], size)[0, 0]
