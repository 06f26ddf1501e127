"""Pixels of edited photographs, and sums over them: all that fitting a look needs to know of a photograph.

A look is linear in its parameters, so the fit needs only the sums of products of its columns, one for each parameter.
For every channel these are a tone curve's hat functions, the three colours, the distance from the largest of them at
each saturation, the bands of blurs, the changes by automatic levels and by local tone curves, and the layers of the
filter. See :mod:`nlfilter_torch.photo.looks.look_filter`.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from nlfilter_torch.photo.looks.histogram import KINDS_OF_LEVELS, STRENGTHS
from nlfilter_torch.photo.looks.look_filter import BLURS, below_largest, saturation_hats

Parts = tuple[str, ...]  # of a look; ``tone`` is one curve for all channels, ``curves`` one for each
SAMPLED_PIXELS = 1 << 16  # pixels of a pair that sums are taken over
SQUARES = 3  # a single pair is divided into so many parts along each side, which are the folds


@dataclass(frozen=True)
class PartLayout:
    """Layout of the columns of each channel, by the parts of a look.

    Attributes:
        knots: K of a tone curve.
        factors: of saturation.
        sliders: of the filter.
    """

    knots: int
    factors: int
    sliders: int

    @property
    def lengths(self) -> dict[str, int]:
        """Columns of each kind, in their order."""
        return {
            "curves": self.knots,
            "matrix": 3,
            "saturation": self.factors,
            "bands": BLURS + 1,
            "texture": BLURS,
            "stretch": KINDS_OF_LEVELS,
            "local": STRENGTHS,
            "alpha": self.sliders,
        }

    @property
    def columns(self) -> int:
        """Number F of columns of a channel."""
        return sum(self.lengths.values())

    def place(self, part: str) -> slice:
        """The columns of a part."""
        names = list(self.lengths)
        start = sum(list(self.lengths.values())[: names.index(part)])
        return slice(start, start + self.lengths[part])

    def parameters(self, parts: Parts) -> Iterator[tuple[str, slice, slice]]:
        """Yield part, channels and place in the vector of parameters, for each group of parameters of some parts.

        Curves and matrix have a group for each channel, other parts one for all channels.
        """
        start = 0
        for part in parts:
            length = self.lengths["curves" if part == "tone" else part]
            groups = [slice(c, c + 1) for c in range(3)] if part in ("curves", "matrix") else [slice(3)]
            for channels in groups:
                yield part, channels, slice(start, start + length)
                start += length

    def spread(self, parts: Parts) -> Tensor:
        """Matrix (3, F, P) from the parameters of some parts to the coefficients of the columns of every channel."""
        groups = list(self.parameters(parts))
        matrix = torch.zeros(3, self.columns, groups[-1][2].stop, dtype=torch.float64)
        for part, channels, place in groups:
            columns = self.place("curves" if part == "tone" else part)
            matrix[channels, columns, place] = torch.eye(place.stop - place.start, dtype=torch.float64)
        return matrix


@dataclass(frozen=True)
class LookSums:
    """Sums over pixels, for each channel.

    Attributes:
        gram: of the columns, (3, F, F), in float64.
        cross: of columns and change, (3, F).
        power: of the change, (3,).
    """

    gram: Tensor
    cross: Tensor
    power: Tensor

    def __add__(self, other: "LookSums") -> "LookSums":
        """Add the sums of two sets of pixels."""
        return LookSums(self.gram + other.gram, self.cross + other.cross, self.power + other.power)

    def left(self, coefficients: Tensor) -> float:
        """Sum of squares of the change that coefficients (3, F) leave unexplained."""
        explained = 2 * (coefficients * self.cross).sum()
        explained = explained - torch.einsum("cf,cfg,cg->", coefficients, self.gram, coefficients)
        return float(self.power.sum() - explained)

    def explained(self, coefficients: Tensor) -> float:
        """Share of the change that coefficients (3, F) explain, 1 at best."""
        return 1.0 - self.left(coefficients) / max(float(self.power.sum()), 1e-30)


class PixelSample(NamedTuple):
    """Pixels of photographs before and after an edit.

    Attributes:
        before: (3, P).
        after: (3, P).
        surroundings: columns of the parts of a look that depend on the surroundings of a pixel, (3, F', P), as for
            :func:`columns_of`; F' is 0 for pixels that only colours are fitted to.
        weights: (3, P); 0 for values that are clipped after the edit.
        shown: weights (P,) of the pixels regardless of clipping.
        square: number of the part of the picture that a pixel is in, (P,), see :func:`squares`.
        fold: number of the fold that its pair is in, (P,).
    """

    before: Tensor
    after: Tensor
    surroundings: Tensor
    weights: Tensor
    shown: Tensor
    square: Tensor
    fold: Tensor

    @staticmethod
    def joined(samples: Iterable["PixelSample"]) -> "PixelSample":
        """The pixels of several samples."""
        return PixelSample(*(torch.cat(values, dim=-1) for values in zip(*samples, strict=True)))

    def at(self, places: Tensor | slice) -> "PixelSample":
        """Some of the pixels."""
        return PixelSample(*(values[..., places] for values in self))

    def every(self, step: int) -> "PixelSample":
        """Each ``step``-th of the pixels, with ``step`` times their weights."""
        few = self.at(slice(None, None, step))
        return few._replace(weights=few.weights * step, shown=few.shown * step)

    def columns(self, layout: PartLayout) -> Tensor:
        """See :func:`columns_of`."""
        return columns_of(self.before, self.surroundings, layout)

    def sums(self, layout: PartLayout) -> list[LookSums]:
        """Sums over the pixels of each square, one after the other to save memory."""
        parts = (self.at((self.square == i).nonzero().squeeze(1)) for i in self.square.unique())
        return [sums_of(part.columns(layout), part.after - part.before, part.weights) for part in parts]


def sample(weights: Tensor, most: int | None = None) -> Tensor:
    """Indices (P,), ascending, of the pixels that sums are taken over, from weights (H, W).

    They are all pixels of positive weight, or ``most`` of them (None: :data:`SAMPLED_PIXELS`): one at random of each
    run of equal length.
    """
    most = SAMPLED_PIXELS if most is None else most
    places = weights.flatten().nonzero().squeeze(1)
    if len(places) <= most:
        return places
    random = torch.rand(most, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return places[((torch.arange(most) + random) * (len(places) / most)).long().to(places.device)]


def squares(places: Tensor, width: int) -> Tensor:
    """Number of the part of a picture that each pixel (P,) is in: their bounding box is divided into equal parts."""
    if len(places) == 0:
        return places
    rows, columns = (
        (numbers - numbers.min()) * SQUARES // (numbers.max() - numbers.min() + 1)
        for numbers in (places // width, places % width)
    )
    return rows * SQUARES + columns


def columns_of(image: Tensor, surroundings: Tensor, layout: PartLayout) -> Tensor:
    """Columns (3, F, P), in float64: what a unit of each parameter changes at some pixels.

    Args:
        image: pixels (3, P) before the edit.
        surroundings: columns (3, F', P) of the parts that depend on the surroundings of a pixel: all from ``bands`` on.
        layout: of the columns.
    """
    colours = image.double()  # the columns nearly depend on each other
    knots = torch.arange(layout.knots).to(colours).view(-1, 1)
    hats = (1 - (colours.clamp(0, 1).unsqueeze(1) * (layout.knots - 1) - knots).abs()).clamp(min=0)
    steps = saturation_hats(colours[None, :, None], layout.factors)[0, :, 0]
    below = below_largest(colours[None])[0].unsqueeze(1) * steps
    return torch.cat([hats, colours.expand(3, -1, -1), below, surroundings.double()], dim=1)


def sums_of(columns: Tensor, change: Tensor, weights: Tensor) -> LookSums:
    """Sums over pixels with columns (3, F, P), change (3, P) and weights (3, P)."""
    columns, change, weights = (values.double() for values in (columns, change, weights))
    weighed = columns * weights.unsqueeze(1)
    cross = (weighed @ change.unsqueeze(2)).squeeze(2)
    return LookSums(weighed @ columns.mT, cross, (weights * change.square()).sum(1))
