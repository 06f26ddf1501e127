"""Surroundings and texture of pixels, as channels of a guide: they tell apart areas of the same brightness."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from nlfilter_torch.filtering.scribbles import fit_strokes
from nlfilter_torch.operator.features import blur, blur_margin, pad_border
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.photo.picture.boxes import in_boxes
from nlfilter_torch.photo.picture.colour import LIGHTNESS, hundredths_of_lab
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, scribbled_blocks
from nlfilter_torch.photo.picture.source import Blocks, Guide, Operator, Planes, Reduced, at, kept
from nlfilter_torch.photo.selections.connected import Extent
from nlfilter_torch.photo.selections.object_model import object_masks
from nlfilter_torch.photo.selections.scribbled_colours import (
    EPSILON,
    REFERENCE,
    evenness,
    frame_places,
    inner_places,
    likeness,
    linked_evenly,
    outwards,
)

# Gaussians, in pixels: surroundings, grain, average of its strength.
SURROUND_SIGMA, GRAIN_SIGMA, TEXTURE_SIGMA = 2.0, 1.5, 3.0
TEXTURE_MARGIN = max(blur_margin(SURROUND_SIGMA), blur_margin(GRAIN_SIGMA) + blur_margin(TEXTURE_SIGMA))


def textured_channels(count: int) -> int:
    """Number of channels of :func:`with_texture` for so many planes: these, their means, and three of texture."""
    return 2 * count + 3


def with_texture(planes: Tensor, brightness: Tensor, weight: float) -> Tensor:
    """Append the means of planes around each pixel and the strength of the texture there.

    Args:
        planes: (B, C, H, W).
        brightness: (B, 1, H, W), of which the texture is measured.
        weight: of the texture.

    Returns:
        (B, 2 C + 3, H, W): the planes, their means, and ``weight`` times the strength of grain and of both gradients.
    """
    # In float32, blurred planes of a mirrored picture would differ by rounding, and with them its landmarks.
    planes, brightness, dtype = planes.double(), brightness.double(), planes.dtype
    padded = pad_border(brightness, 1)
    rows, columns = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    grain = torch.cat([brightness - blur(brightness, GRAIN_SIGMA), rows / 2, columns / 2], dim=1)
    strength = (blur(grain.square(), TEXTURE_SIGMA) + 1e-8).sqrt()  # the derivative of the root is finite
    return torch.cat([planes, blur(planes, SURROUND_SIGMA), weight * strength], dim=1).to(dtype)


CHROMA_WEIGHT = 0.7  # weight of hue and saturation; that of lightness is LIGHTNESS
GUIDE_TEXTURE = 1.5
SMOOTHNESS = 0.25  # of the regression
MIDDLE = 0.4  # of the sides of a box: the part of it that stands for scribbles on its object where there are none
FRAME_PIXELS = math.prod(REFERENCE)  # in larger pictures points of the frame count more, as scribbles have more pixels

ScribbledPoints = tuple[Callable[[], Iterable[Tensor]], Tensor, Tensor]  # columns, weights and values of pixels


def region_guide(image: Tensor) -> Tensor:
    """Guide of the operator, (B, 9, H, W): colour, surrounding colour, and strength of the texture."""
    lab = hundredths_of_lab(image)
    colours = lab * lab.new_tensor([LIGHTNESS, CHROMA_WEIGHT, CHROMA_WEIGHT]).view(1, 3, 1, 1)
    return with_texture(colours, lab[:, :1], GUIDE_TEXTURE)


@dataclass(frozen=True, eq=False)
class Points:
    """Pixels of a picture that are not scribbled on but compared with those that are.

    Attributes:
        places: their row-major indices (n,), ascending.
        columns: their columns of the factor, block by block.
        colours: (B, C, n).
    """

    places: Tensor
    columns: Blocks
    colours: Tensor

    @staticmethod
    def of(picture: Reduced, operator: Operator, places: Tensor) -> "Points":
        """Read the pixels of a picture at these places."""
        return Points(places, operator.at(places), at(picture, places)[0])

    def values(self, planes: Tensor) -> Tensor:
        """Values (B, C, n) of planes (B, C, H, W) at the points."""
        return planes.flatten(2)[:, :, self.places]


@dataclass(frozen=True, eq=False)
class RoughMasks:
    """Rough masks of the regions of a picture, from the scribbles on each.

    Attributes:
        picture: the reduced picture.
        operator: its filter.
        frame: points along its borders.
        grid: points inside it.
        photometric_bandwidth: of the filter.
        reach: that of :func:`region_mask`.
        extent: that of :func:`region_mask`.
        boxes: rectangles that hold the objects of K regions, (B, K, 4) in pixels of the reduced picture, or None.
    """

    picture: Reduced
    operator: Operator
    frame: Points
    grid: Points
    photometric_bandwidth: Tensor
    reach: float | Tensor
    extent: Extent = "near"
    boxes: Tensor | None = None

    @staticmethod
    def of(
        picture: Reduced,
        options: FilterOptions,
        reach: float | Tensor,
        extent: Extent,
        boxes: Tensor | None = None,
    ) -> "RoughMasks":
        """Prepare a picture: build its operator, with options of :func:`nonlocal_operator`, and choose the points."""
        guide = Guide(options, region_guide, TEXTURE_MARGIN, textured_channels(3), spectral=True, sampled=True)
        operator = picture.operator(guide)
        frame, grid = (Points.of(picture, operator, choose(picture.size)) for choose in (frame_places, inner_places))
        bandwidth = torch.as_tensor(options.photometric_bandwidth, dtype=picture.dtype)
        return RoughMasks(picture, operator, frame, grid, bandwidth, reach, extent, boxes)

    @cached_property
    def evenness(self) -> Tensor:
        """:func:`evenness` of the picture."""
        return kept(self.picture, "evenness", [], evenness, self.picture.image)

    @cached_property
    def guide(self) -> Tensor:
        """:func:`region_guide` of the picture."""
        return kept(self.picture, "guide", [], region_guide, self.picture.image)

    def mask(self, number: int, scribbles: Scribbles) -> Tensor:
        """The rough mask (B, 1, H, W) of a region with that number, from scribbles on it and on its background.

        With boxes, there may be no scribbles on it.
        """
        held = None if self.boxes is None else self.boxes[:, number : number + 1]
        drawn = scribbles.planes(self.picture)
        if held is not None:
            scribbles = self.with_middle(scribbles, held)
        colours, weights = outwards(scribbles, self.picture.size)
        planes = scribbles.planes(self.picture)
        unlike = 1 - likeness(colours, weights[:, :1], self.frame.colours, self.photometric_bandwidth)
        linked = linked_evenly(self.evenness, planes)
        frame_links, grid_links = self.frame.values(linked), self.grid.values(linked)
        known = self.scribbled(scribbles)
        outside = self.outside(known, unlike)
        likely = self.regression(known, outside, frame_links, grid_links)(self.picture)
        boxed = None if held is None else in_boxes(held, self.picture)
        front, back = planes.split(1, dim=1)
        sides = torch.cat([front.maximum(linked * (1 - back)), back], dim=1)
        return kept(
            self.picture,
            ("object", number, self.extent),
            [likely, sides, drawn] if boxed is None else [likely, sides, drawn, boxed],
            object_masks,
            self.picture.image,
            self.guide,
            likely,
            sides,
            drawn,
            boxed,
            self.extent,
        )

    def with_middle(self, scribbles: Scribbles, boxes: Tensor) -> Scribbles:
        """Scribbles, with those on the region in the middle of its box (B, 1, 4) in images that have none."""
        around = (boxes[..., :2] + boxes[..., 2:]) / 2, (boxes[..., 2:] - boxes[..., :2]) * MIDDLE / 2
        middles = torch.cat([around[0] - around[1], around[0] + around[1]], dim=2)
        middle = in_boxes(middles, self.picture).to(scribbles.weights)
        front, back = scribbles.planes(self.picture).split(1, dim=1)
        bare = front.detach().amax((2, 3), keepdim=True) == 0
        planes = torch.cat([torch.where(bare, middle * (1 - back), front), back], dim=1)
        return scribbles.repainted(planes, self.picture.image)

    @property
    def pixels(self) -> int:
        """Number of pixels of the picture."""
        return self.picture.size[0] * self.picture.size[1]

    def fit(self, known: Sequence[ScribbledPoints], strength: float) -> Callable[[Tensor], Tensor]:
        """The regression on scribbled pixels and points."""
        return fit_strokes(
            partial(scribbled_blocks, known),
            pairs=self.operator.pairs,
            pixels=self.pixels,
            reach=self.reach,
            smoothness=SMOOTHNESS,
            strength=strength,
        )

    def scribbled(self, scribbles: Scribbles) -> ScribbledPoints:
        """The pixels of scribbles, with their weights and the share of the region in these."""
        total = scribbles.weights.sum(1, keepdim=True)
        values = scribbles.weights[:, :1] / total.clamp(min=EPSILON)
        return self.operator.at(scribbles.places), total.clamp(max=1.0), values

    def outside(self, known: ScribbledPoints, unlike: Tensor) -> Tensor:
        """How much points of the frame count as background, (B, 1, n).

        All that are unlike the region but those that a regression on the scribbles alone assigns to it. The regression
        fades to 0 where nothing similar is scribbled, so that scribbles on the background take nothing from what the
        frame says elsewhere.

        Args:
            known: :meth:`scribbled` pixels, on the region and on its background.
            unlike: dissimilarity of the frame to the scribbles on the region, (B, 1, n).
        """
        alone = self.fit([known], strength=0.0)
        return unlike * torch.cat(
            [(1 - alone(block)).clamp(0.0, 1.0).square() for block in self.frame.columns()], dim=2
        )

    def regression(self, known: ScribbledPoints, outside: Tensor, frame_links: Tensor, grid_links: Tensor) -> Planes:
        """Likelihood that a pixel belongs to a region: about 1 inside and about 0 outside; not clamped.

        Args:
            known: :meth:`scribbled` pixels, on the region and on its background.
            outside: :meth:`outside` of the frame, (B, 1, n).
            frame_links: :func:`linked_evenly` of the frame to these, (B, 1, n).
            grid_links: the same of the grid, (B, 1, m).
        """
        points = [
            known,
            (self.frame.columns, outside * max(1.0, self.pixels / FRAME_PIXELS), frame_links),
            (self.grid.columns, grid_links, torch.ones_like(grid_links)),
        ]
        return self.operator.of_columns(_of_columns, self.fit(points, strength=1.0))


def _of_columns(columns: Columns, regression: Callable[[Tensor], Tensor]) -> Tensor:
    """A regression at the pixels of these columns."""
    return regression(columns.factor)
