"""Colouring of a grey photograph from a few strokes of colour. Paper: Sec. V-B, Fig. 16.

Three estimates of the chroma are averaged: the regression on the strokes relates pixels of similar brightness and
texture, however far apart; two :class:`LocalValues` relate pixels that are connected without an edge between them, with
two notions of an edge. Their errors are in different places, so that the mean is better than each.

An estimate counts less the farther it is from the other two and the more saturated it is. The regression also counts
less where no stroke is on similar pixels nearby, and where strokes on similar pixels differ in colour. The estimate by
relative differences has the fewest large errors, so that the distance of the mean from it is limited. It and the
regression are compared by predicting the colour of each stroke from other strokes: the smaller the errors of the
regression are in comparison, and the more strokes there are, the more it counts, and the larger the distance may be.

Where there are few strokes, of few colours, the mean is blended with what cuts of the picture between these colours
give, as for masks of objects: they follow its borders, and know of texture and of surroundings.

Shadows and highlights of an object have less chroma than its midtones. The regression therefore extends chroma relative
to :func:`usual_chroma`, and propagation between neighbours relative to its square root; that by relative differences
only where this reduces the chroma.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Generic, Literal, cast

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_patch_size, check_positive, check_values
from nlfilter_torch.core.precision import per_image, squarable
from nlfilter_torch.filtering.masks import segment
from nlfilter_torch.filtering.scribbles import fit_strokes
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.operator.spectrum import Spectrum
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import COLORIZE, MASK
from nlfilter_torch.photo.picture.boxes import (
    boxes_of,
    check_scribbles_in,
    held,
    in_boxes,
    just_outside,
    scaled,
)
from nlfilter_torch.photo.picture.colour import (
    group_colours,
    merge_luminance,
    region_means,
    split_luminance,
    with_green,
)
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.measuring import check_in_memory, everywhere, reduced
from nlfilter_torch.photo.picture.pixels import Box, M, part_of
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, scribbled_blocks
from nlfilter_torch.photo.picture.source import (
    Fitted,
    Guide,
    Operator,
    Pixels,
    Planes,
    Source,
    at,
    kept,
    luminance,
)
from nlfilter_torch.photo.picture.viewing import Coarse, viewed_size
from nlfilter_torch.photo.selections.connected import StrokeGroups
from nlfilter_torch.photo.selections.local_values import ABSOLUTE, RELATIVE, Links, LocalValues
from nlfilter_torch.photo.selections.mask import RegionMask, Regions, blocks_of, fit_regions
from nlfilter_torch.photo.selections.rough_mask import TEXTURE_MARGIN, with_texture

Method = Literal["regression", "kmeans"]


@dataclass(frozen=True)
class Stage:
    """One of several regressions, each on the residual of the strokes' chroma after the previous ones.

    Attributes:
        spatial: factor of the spatial bandwidth.
        photometric: factor of the photometric bandwidth.
        reach: that of :func:`propagate_strokes`.
        smoothness: that of :func:`propagate_strokes`.
    """

    spatial: float
    photometric: float
    reach: float
    smoothness: float


# These, the defaults of COLORIZE and the constants of LocalValues were chosen on the pictures that benchmarks.colorize
# names for that and on others, with 6 to 60 random strokes.
FAR, NEAR = Stage(1.0, 1.0, 0.95, 0.7), Stage(2 / 9, 3.0, 0.9, 0.7)
BLOCKS = 8  # least number of blocks along the short side whose mean brightness is compared
SAME_BRIGHTNESS = 1e-3  # mean difference of blocks that hardly counts
ANISOTROPY, MOST_ANISOTROPY = 2.5, 3.0  # exponent of the ratio of differences, and limit of the resulting ratio
# With this scale, a difference in brightness between two even areas is also the difference of their guides, whose
# channels of texture are then 0.
GUIDE_SCALE = math.sqrt(5 / 2)
TEXTURE_WEIGHT = 3.0
LEAST_CHROMA = 0.01  # square of the usual chroma of black and white
NO_CHROMA = 1e-8  # square of a saturation that cannot be seen; keeps quotients and derivatives finite
LEAST_SUPPORT = 0.05  # of a pixel by the strokes nearby
RELATIVE_WEIGHT = 0.5  # factor of the estimate by relative differences
# In units of the saturation of the strokes, or of its square, so that strokes of half the saturation give half of it.
SAME_CHROMA = 0.02  # difference of estimates that hardly counts
FAINT = 1.0  # chroma below which estimates differ little in weight
LARGE_VARIANCE = 0.45  # of chroma among strokes on similar pixels
# Limit of the distance of the result from the estimate by relative differences, if this and the regression predict many
# strokes equally well.
MOST_CHANGE = 1.6
SAME_ERROR = 0.13  # squared error of a predicted stroke that hardly counts
ERROR_EXPONENT, MOST_WEIGHT = 2.0, 3.0  # exponent of the ratio of errors, and limit of the resulting factor
COLOUR_ROWS = 16  # rows of a photograph that are read to see whether it is in colour
COLOURED, COLOURED_SHARE = 0.04, 0.01  # difference of channels in a coloured pixel, and share of such pixels
# Colours up to which objects are cut out, since each takes as long as a mask, and number of strokes at which that
# counts half. They were chosen as the constants above.
MOST_CUT, CUT_HALF = 8, 8
FEW_STROKES = 5  # number of compared strokes at which the factor is about half of that for many


def colorize_guide(image: Tensor) -> Tensor:
    """Guide of the regression, (B, 5, H, W): brightness, that of the surroundings, and strength of the texture."""
    brightness = reduce_channels(image, "luminance")
    return GUIDE_SCALE * with_texture(brightness, brightness, TEXTURE_WEIGHT)


def colorize(
    grey: Tensor,
    strokes: Tensor,
    stroke_mask: Tensor,
    *,
    box: Box | None = None,
    method: Method = COLORIZE.defaults["method"],
    strength: float | Tensor = COLORIZE.defaults["strength"],
    time: float | Tensor = 1.0,
    photometric_bandwidth: float | Tensor = COLORIZE.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = COLORIZE.defaults["patch_size"],
    num_landmarks: int = COLORIZE.defaults["num_landmarks"],
    viewing_size: float = COLORIZE.defaults["viewing_size"],
    generator: torch.Generator | None = None,
) -> Tensor:
    """Colour a grey image from strokes; its luminance is kept.

    Paper: Sec. V-B. ``"regression"`` extends the chroma of the strokes by :func:`propagate_strokes`, first over long
    distances, then the residual near the strokes. Two estimates by propagation between neighbouring pixels up to edges
    are blended in. The regression counts more the better it predicts the colour of each stroke from other strokes. If
    there are few strokes, of at most 8 colours, cuts between their areas, as of :func:`region_mask`, count, too, where
    no stroke is connected without an edge.
    Shadows and highlights get less chroma than midtones of the same object. ``"kmeans"`` is the paper's method:
    :func:`segment_mask` divides the image into one segment per colour.

    Args:
        grey: (B, 1, H, W) in [0, 1].
        strokes: (B, 3, H, W), RGB, of which only the chroma is used, and less of it the more the luminance of a stroke
            differs from that under it.
        stroke_mask: (B, 1, H, W) in [0, 1], above 0 where painted. Grey strokes keep similar pixels grey.
        box: ``(left, top, right, bottom)`` in pixels, a rectangle that holds all that is coloured, or a tensor
            (B, 1, 4): what lies outside stays grey, and pixels just outside count as grey strokes.
        method: ``"regression"`` or ``"kmeans"``.
        strength: for the regression, in [0, 1]: at 1 every pixel is coloured, at 0 pixels similar to no stroke stay
            grey.
        time: for k-means, diffusion time t > 0 of the segments.
        photometric_bandwidth: in units of the image; how much grey levels of one colour may differ. Brightness of the
            surroundings and texture, if they differ, count as further differences.
        spatial_bandwidth: in pixels: the geometric mean of the vertical and the horizontal bandwidth. The one along
            which brightness changes more is smaller, by a factor of at most 3. None is 0.7 of the short side.
        patch_size: width of the compared patches.
        num_landmarks: M of the operator.
        viewing_size: in megapixels; the colours of a larger image are found in its reduction to this size, patches and
            bandwidths are in pixels of that, and borders between colours follow the image's; 0 is the size of the
            image.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        RGB (B, 3, H, W), in [0, 1] where ``grey`` is; chroma is scaled down where the luminance requires it.
        Differentiable in image, strokes, mask and bandwidths with ``"regression"``, in the strokes only with
        ``"kmeans"``.

    Raises:
        TypeError, ValueError: if a tensor has another size, the mask leaves [0, 1], or nothing is painted; if the box
            does not lie in the picture, or most of the strokes do not lie in it.

    Example:
        >>> grey = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0)) * 0.2 + 0.1
        >>> grey[..., 12:] += 0.6
        >>> strokes, painted = torch.zeros(1, 3, 24, 24), torch.zeros(1, 1, 24, 24)
        >>> strokes[:, 2, :4, :4], strokes[:, 0, :4, -4:] = 0.8, 0.8  # dark is blue, bright is red
        >>> painted[..., :4, :4] = painted[..., :4, -4:] = 1
        >>> colour = colorize(grey, strokes, painted, num_landmarks=50)
        >>> bool((colour[:, 2] > colour[:, 0])[..., :10].all()), bool((colour[:, 0] > colour[:, 2])[..., 14:].all())
        (True, True)
    """
    return edited(Colorize, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Colorize(PhotoEdit):
    """The edit of :func:`colorize`."""

    declared: ClassVar[Edit] = COLORIZE
    image_channels: ClassVar[int | None] = 1
    method: Method
    strength: float | Tensor
    time: float | Tensor = 1.0
    viewing_size: float

    def notes(self, rows: Rows) -> Iterator[str]:
        """Note that a photograph in colour loses its own colours."""
        height, step = rows.size[0], max(1, rows.size[0] // COLOUR_ROWS)
        sample = torch.cat([rows.read(slice(y, y + 1)).float() for y in range(step // 2, height, step)], dim=2)
        if bool(((sample.amax(1) - sample.amin(1)) > COLOURED).float().mean() > COLOURED_SHARE):
            yield (
                f"{rows.name} is in colour: colorize replaces its colours everywhere by those of the scribbles; "
                "to change the colour of one object, use recolor"
            )

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the colours to strokes."""
        self._check(source)
        strokes = scribbles = source.scribbles(drawn.masks.get("stroke_mask"), drawn.colours, "stroke_mask")
        small = viewed_size(source.size, self.viewing_size)
        viewed = source if small == source.size else source.resized(small)
        if viewed is not source:
            steps = (source.size[0] / small[0], source.size[1] / small[1])
            scribbles = blocks_of(scribbles, viewed, source.size, steps)
        boxes = None
        if drawn.box is not None:
            boxes = boxes_of(drawn.box, source.size, source.batch, 1)
            check_scribbles_in(boxes, [strokes], source.size, "strokes")
            scribbles = grey_outside(viewed, scribbles, scaled(boxes, source.size, small))
        ratio = viewed.measured(bandwidth_ratio)
        options = self.filter_options(small, fewer_landmarks=True)
        # Not None, whose place a share of the size takes, and a single one.
        mean = per_image(cast(float | Tensor, options.spatial_bandwidth), ratio, 1)
        bandwidths = (mean / ratio.sqrt()).to(viewed.dtype), (mean * ratio.sqrt()).to(viewed.dtype)
        operators = Operators(options, viewed, bandwidths)
        wanted = squarable(split_luminance(scribbles.shown.unsqueeze(2))[1]).squeeze(2)  # (B, 3, n)
        if self.method == "kmeans":
            fitted = _coloured(source, viewed, self._segments(operators, scribbles, wanted))
        else:
            fitted = _coloured(source, viewed, Estimates.of(operators, scribbles, wanted[:, ::2], self.strength))
        return fitted if boxes is None else replace(fitted, pixels=partial(_grey_beyond, boxes, fitted.pixels))

    def _check(self, source: Source[M]) -> None:
        """Raise an error for an invalid setting."""
        COLORIZE.check(method=self.method)
        if self.method == "kmeans":
            check_in_memory(
                source,
                "method must be regression for a picture processed in tiles, got kmeans, which needs all pixels in "
                "memory; choose regression, or allow more memory",
            )
        COLORIZE.check(source.batch, strength=self.strength)
        check_positive(self.time, "time", source.batch)
        options = self.options
        check_values(options.photometric_bandwidth, "photometric_bandwidth", "positive", source.batch)
        if options.spatial_bandwidth is not None:
            check_values(options.spatial_bandwidth, "spatial_bandwidth", "positive", source.batch)
        check_patch_size(options.patch_size)
        check_count(options.num_landmarks, "num_landmarks")
        COLORIZE.check(viewing_size=self.viewing_size)

    def _segments(self, operators: "Operators[M]", scribbles: Scribbles, wanted: Tensor) -> Planes:
        """Chroma, red and blue, of the segment of each pixel."""
        regions, colours, valid = group_colours(wanted.unsqueeze(2), scribbles.weights.unsqueeze(2))
        planes = everywhere(operators.viewed, Fitted(scribbles.weighted(regions.squeeze(2)).planes))
        pieces = segment(cast(Spectrum, operators.of(FAR).pairs), planes, self.time, valid)
        return part_of(torch.einsum("bkhw,bkc->bchw", pieces, colours)[:, ::2])


@dataclass(frozen=True, eq=False)
class Operators(Generic[M]):
    """The operators of a picture for the stages of a regression.

    Attributes:
        options: of the filter, with the bandwidths of a stage whose factors are 1.
        viewed: the picture at the viewing size.
        bandwidths: vertical and horizontal bandwidth, (B,) each.
    """

    options: FilterOptions
    viewed: Source[M]
    bandwidths: tuple[Tensor, Tensor]

    @property
    def pixels(self) -> int:
        """Number of pixels of the picture."""
        return self.viewed.size[0] * self.viewed.size[1]

    def of(self, stage: Stage) -> Operator:
        """Build the operator of a stage."""
        options = replace(
            self.options,
            photometric_bandwidth=stage.photometric * self.options.bandwidth_or(lambda: 1.0),
            spatial_bandwidth=(stage.spatial * self.bandwidths[0], stage.spatial * self.bandwidths[1]),
        )
        return self.viewed.operator(Guide(options, colorize_guide, TEXTURE_MARGIN, 5, spectral=True))


@dataclass(frozen=True, eq=False)
class Estimates(Generic[M]):
    """The chroma of the pixels of a picture as a mean of three estimates.

    Attributes:
        viewed: the picture at the viewing size.
        saturation: of the strokes, (B, 1, 1), the unit of all chroma.
        far: results of the regression over long distances: chroma, and the mean of its squared saturation.
        near: results of the regression nearby: the residual of the chroma, and the support by strokes.
        absolute: propagation by absolute differences.
        relative: propagation by relative differences: relative to the usual chroma, and unscaled.
        everywhere: the strength of the edit, (B, 1, 1, 1).
        regression_weight: factor of the regression.
        cut: what cuts between the colours give, or None.
    """

    viewed: Source[M]
    saturation: Tensor
    far: Planes
    near: Planes
    absolute: LocalValues
    relative: LocalValues
    everywhere: Tensor
    regression_weight: float | Tensor
    cut: "Cut | None"

    @staticmethod
    def of(operators: Operators[M], scribbles: Scribbles, wanted: Tensor, strength: float | Tensor) -> "Estimates[M]":
        """Fit the estimates to the chroma, red and blue, (B, 2, n), of scribbles; green follows from these."""
        viewed = operators.viewed
        groups = StrokeGroups.of(scribbles, viewed.size)
        wanted = suited(groups, scribbles, wanted)
        mean_square = region_means(squared_sum(wanted).unsqueeze(2), scribbles.weights.unsqueeze(2))  # (B, 1, 1)
        saturation = (mean_square + NO_CHROMA).sqrt()
        wanted = wanted / saturation
        usual = usual_chroma(scribbles.image.unsqueeze(2)).squeeze(2)
        scaled = wanted / usual.sqrt()
        propagation = Propagation(viewed, scribbles, groups)
        absolute = propagation.solve(ABSOLUTE, scaled)
        relative = propagation.solve(RELATIVE, torch.cat([scaled, wanted], dim=1), wanted)
        weights = [scribbles.weights, *groups.weights_without_each(scribbles.weights)]
        (far, near), residuals = extended(operators, scribbles.places, weights, wanted / usual, strength)
        regression_weight = factor_of_count(0)
        if relative.left_out is not None:
            residual = groups.of_own(residuals[1:]) * usual
            regression_weight = compared(groups, scribbles.weights, residual, wanted, relative.left_out)
        everywhere = per_image(strength, wanted, 4)
        cut = Cut.of(operators, scribbles, wanted, groups.sums(scribbles.weights), everywhere)
        return Estimates(viewed, saturation, far, near, absolute, relative, everywhere, regression_weight, cut)

    def __call__(self, pixels: Pixels) -> Tensor:
        """The chroma of pixels, (B, 2, h, w)."""
        own = luminance(pixels)
        usual = usual_chroma(own)
        connected, influence = self._interpolated(self.absolute, pixels, own).tensor_split([2], dim=1)
        around, unscaled = self._interpolated(self.relative, pixels, own)[:, :4].split(2, dim=1)
        around = limit_saturation(unscaled, around * usual.sqrt())
        mean, square = self.far(pixels).tensor_split([2], dim=1)
        residual, support = self.near(pixels).tensor_split([2], dim=1)
        variance = (square - squared_sum(mean)) * usual.square()
        alike = (mean + residual) * usual
        around = torch.lerp(alike, around, influence + self.everywhere * (1 - influence))
        connected = torch.lerp((alike + around) / 2, connected * usual.sqrt(), influence)
        trust = (support.clamp(min=0.0) + LEAST_SUPPORT) ** 1.5 / (1 + variance.clamp(min=0.0) / LARGE_VARIANCE)
        factors = self.regression_weight * trust, influence**2, RELATIVE_WEIGHT
        change = weighted_mean((alike, connected, around), factors) - around
        limited = change * (1 + squared_sum(change) / (self.regression_weight * MOST_CHANGE**2)).rsqrt()
        chroma = around + limited
        if self.cut is not None:
            chroma = self.cut.blended(chroma, influence, pixels)
        return self.saturation.unsqueeze(3) * chroma

    def _interpolated(self, estimate: LocalValues, pixels: Pixels, own: Tensor) -> Tensor:
        place = (estimate.links, pixels.first, pixels.image.shape)
        return kept(self.viewed, place, [estimate.values], estimate, own, pixels.first)


@dataclass(frozen=True, eq=False)
class Cut:
    """The chroma of pixels by cuts between the colours of strokes.

    Attributes:
        objects: masks of what each of K colours is meant for.
        colours: chroma of these, (B, K, 2), 0 where an image has fewer.
        valid: which of them each image has, (B, K, 1, 1).
        share: of this estimate, (B, 1, 1, 1).
    """

    objects: Regions
    colours: Tensor
    valid: Tensor
    share: Tensor

    @staticmethod
    def of(
        operators: Operators[M], scribbles: Scribbles, chroma: Tensor, strokes: Tensor, strength: Tensor
    ) -> "Cut | None":
        """Cut the picture between scribbles of chroma (B, 2, n); None if there are one or many colours in all images.

        Args:
            operators: of the picture.
            scribbles: on it.
            chroma: of these.
            strokes: weights of each stroke, (B, 1, S).
            strength: of the edit, (B, 1, 1, 1).
        """
        regions, colours, valid = group_colours(with_green(chroma.unsqueeze(2)), scribbles.weights.unsqueeze(2))
        counts = valid.sum(1)
        few = ((counts > 1) & (counts <= MOST_CUT)).to(chroma)
        if not bool(few.any()):
            return None
        grey = replace(scribbles, image=reduce_channels(scribbles.image.unsqueeze(2), "luminance").squeeze(2))
        inside = [grey.weighted(part) for part in regions.squeeze(2).split(1, dim=1)]
        options = operators.options
        chosen = {
            "num_landmarks": options.num_landmarks,
            "landmarks": options.landmarks,
            "generator": options.generator,
        }
        settings = replace(RegionMask.of({**MASK.defaults, "extent": "everywhere", **chosen}), grey=True)
        objects = fit_regions(operators.viewed, inside, [], settings)
        share = few * CUT_HALF / (CUT_HALF + (strokes > 0).sum(2).squeeze(1))
        return Cut(objects, colours[:, :, ::2], valid[..., None, None], share.view(-1, 1, 1, 1) * strength)

    def blended(self, chroma: Tensor, influence: Tensor, pixels: Pixels) -> Tensor:
        """Chroma (B, 2, h, w) of pixels, blended with that of the objects that they belong to.

        The more so the less ``influence`` (B, 1, h, w) strokes have without an edge between: these tell more.
        """
        masks = self.objects.masks(pixels) * self.valid
        total = masks.sum(1, keepdim=True)
        own = torch.einsum("bkhw,bkc->bchw", masks, self.colours) / total.clamp(min=NO_CHROMA)
        return torch.lerp(chroma, own, self.share * (1 - influence) * total.clamp(max=1.0))


@dataclass(frozen=True, eq=False)
class Propagation(Generic[M]):
    """Propagation of values from scribbles to neighbouring pixels of a picture."""

    viewed: Source[M]
    scribbles: Scribbles
    groups: StrokeGroups

    def solve(self, links: Links, values: Tensor, predicted: Tensor | None = None) -> LocalValues:
        """Solve for values (B, C, n) of the scribbled pixels; ``predicted`` are compared with those of other strokes.

        Weights are cubed, so that pixels partly covered by the border of a scribble count little; how many there are
        depends on the size of the picture.
        """
        size, places, cubed = self.viewed.size, self.scribbles.places, self.scribbles.weights**3
        guide = reduced(self.viewed, luminance, links.step(size))
        tensors, known = [guide, places, cubed, values], (size, places, cubed, values, self.groups, predicted)
        return kept(self.viewed, links, tensors, LocalValues.of, links, guide, *known)


def usual_chroma(image: Tensor) -> Tensor:
    """Usual chroma of pixels (B, 1 or 3, H, W) of one colour, (B, 1, H, W): largest halfway from black to white."""
    own = reduce_channels(image, "luminance")
    return ((own * (1 - own)).clamp(min=0.0) + LEAST_CHROMA).sqrt()


def suited(groups: StrokeGroups, scribbles: Scribbles, chroma: Tensor) -> Tensor:
    """Chroma (B, 2, n) of scribbles, reduced where their strokes are darker or lighter than the picture under them.

    Dark green on bright grass would be gaudy: of all greens that bright, few have as much chroma. The factor is the
    geometric mean of 1 and of the one that keeps the saturation of HSL, the share of the chroma that the luminance
    allows. Strokes of the picture's own brightness keep all of it.
    """
    levels = [reduce_channels(part.unsqueeze(2), "luminance") for part in (scribbles.image, scribbles.shown)]
    both = torch.cat(levels, dim=1).squeeze(2).clamp(0.0, 1.0)  # of the picture and of the strokes
    dark, light = (groups.sums((part + LEAST_CHROMA) * scribbles.weights) + NO_CHROMA for part in (both, 1 - both))
    ratio = torch.minimum(dark[:, :1] / dark[:, 1:], light[:, :1] / light[:, 1:])  # (B, 1, S)
    factor = ratio.clamp(max=1.0).sqrt()
    return chroma * factor.gather(2, groups.strokes.unsqueeze(1)).to(chroma)


def bandwidth_ratio(source: Source[M]) -> Tensor:
    """Ratio (B,) of the horizontal to the vertical bandwidth, from changes of brightness at a large scale.

    Where sky, buildings and ground lie above each other, brightness changes more from top to bottom, and so do colours.
    In float64: in float32, the bandwidths of a mirrored picture would differ by rounding, and with them its landmarks.
    """
    step = max(1, min(source.size) // BLOCKS)
    blocks = reduced(source, luminance, step).double()
    changes = [blocks.diff(dim=dim).abs().flatten(1) for dim in (2, 3)]
    down, across = (change.sum(1) / max(1, change.shape[1]) + SAME_BRIGHTNESS for change in changes)
    return (down / across).pow(ANISOTROPY).clamp(1 / MOST_ANISOTROPY, MOST_ANISOTROPY)


def extended(
    operators: Operators[M], places: Tensor, weights: list[Tensor], wanted: Tensor, strength: float | Tensor
) -> tuple[list[Planes], list[Tensor]]:
    """Extend values by the regressions :data:`FAR` and :data:`NEAR`, for several sets of weights.

    Args:
        operators: of the picture.
        places: row-major indices of the scribbled pixels, (n,).
        weights: of the scribbled pixels, for each set (B, 1, n).
        wanted: values of the scribbled pixels, (B, 2, n).
        strength: of the first regression, see :func:`propagate_strokes`.

    Returns:
        Results of both stages for the first set: (B, 3, h, W), the values, and as a third channel for FAR their squared
        sum, from which the variance among strokes on similar pixels follows; for NEAR, the degree to which strokes
        nearby determine a pixel. For every set, the residuals at the scribbled pixels, (B, 2, n).
    """
    residuals = [wanted] * len(weights)
    planes = []
    for stage, other in ((FAR, squared_sum(wanted)), (NEAR, torch.ones_like(wanted[:, :1]))):
        operator = operators.of(stage)
        columns = operator.at(places)
        fits = [
            fit_strokes(
                partial(scribbled_blocks, [(columns, own, torch.cat([residual, other], dim=1))]),
                operator.pairs,
                operators.pixels,
                strength=strength if stage is FAR else 0.0,
                reach=stage.reach,
                smoothness=stage.smoothness,
            )
            for own, residual in zip(weights, residuals, strict=True)
        ]
        explained = [[fit(block)[:, :2] for fit in fits] for block in columns()]  # columns are computed once for all
        residuals = [
            before - torch.cat(blocks, dim=2)
            for before, blocks in zip(residuals, zip(*explained, strict=True), strict=True)
        ]
        planes.append(operator.of_columns(_of_factor, fits[0]))
        del operator  # frees its factor before the next one is computed
    return planes, residuals


def _of_factor(columns: Columns, fit: Callable[[Tensor], Tensor]) -> Tensor:
    """What a regression gives for columns of the factor."""
    return fit(columns.factor)


def compared(groups: StrokeGroups, weights: Tensor, residual: Tensor, wanted: Tensor, left_out: Tensor) -> Tensor:
    """Factor (B, 1, 1, 1) of the regression, from its errors and those of another estimate for strokes left out.

    It is smaller if few strokes are compared.

    Args:
        groups: of the strokes.
        weights: of the scribbled pixels, (B, 1, n).
        residual: of the regression on the other groups, (B, 2, n), in the unit of ``wanted``.
        wanted: chroma of the strokes, (B, 2, n).
        left_out: of the other estimate, see :class:`LocalValues`.
    """
    painted, flow = groups.sums(weights), groups.sums(left_out * (weights > 0))  # (B, 1, S), (B, 3, S)
    valid = (painted > 0) & (flow[:, -1:] > 0)
    painted = torch.where(valid, painted, 1.0)
    error = squared_sum(groups.sums(residual * weights) / painted)
    predicted = flow[:, :-1] / torch.where(valid, flow[:, -1:], 1.0)
    other = squared_sum(predicted - groups.sums(wanted * weights) / painted)
    ratios = ((other + SAME_ERROR) / (error + SAME_ERROR)).log() * valid
    count = valid.sum(2)
    factor = (ERROR_EXPONENT * ratios.sum(2) / count.clamp(min=1)).exp().clamp(max=MOST_WEIGHT)
    return (factor * factor_of_count(count)).to(weights).view(-1, 1, 1, 1)


def factor_of_count(count: float | Tensor) -> float | Tensor:
    """Factor that reduces the weight of the regression if few strokes are compared; approaches 1 for many."""
    return (1 + count) / (1 + count + FEW_STROKES)


def limit_saturation(chroma: Tensor, other: Tensor) -> Tensor:
    """Reduce the saturation of chroma (B, 2, H, W) to that of another chroma, where that is less saturated."""
    return chroma * ((squared_sum(other) + NO_CHROMA) / (squared_sum(chroma) + NO_CHROMA)).clamp(max=1.0).sqrt()


def squared_sum(chroma: Tensor) -> Tensor:
    """Squared saturation (B, 1, ...) of chroma (B, 2, ...)."""
    return chroma.square().sum(1, keepdim=True)


def weighted_mean(estimates: tuple[Tensor, Tensor, Tensor], factors: tuple[float | Tensor, ...]) -> Tensor:
    """Average three estimates (B, 2, H, W).

    The weight of each is its factor, (B, 1, H, W) or a number, divided by its saturation and by its distance from the
    other two.
    """
    alike, connected, around = estimates
    pairs = ((alike, connected), (connected, around), (around, alike))
    first, second, third = (squared_sum(estimate - other) for estimate, other in pairs)
    distances = (first + third, first + second, second + third)
    total, weights = around.new_zeros(()), around.new_zeros(())
    for estimate, factor, distance in zip(estimates, factors, distances, strict=True):
        share = factor * ((squared_sum(estimate) + FAINT**2) * (distance + SAME_CHROMA**2)).rsqrt()
        total, weights = torch.addcmul(total, share, estimate), weights + share
    return total / weights


def _coloured(source: Source[M], viewed: Source[M], chroma: Planes) -> Fitted:
    """A picture in the chroma (B, 2, h, w), red and blue, of its reduction; edges follow those of its luminance.

    A source may be in colour: only its luminance counts.
    """
    if source is viewed:
        return Fitted(partial(_in_chroma, chroma))
    before = everywhere(viewed, Fitted(_luminance_twice))
    coarse = Coarse.of(before, everywhere(viewed, Fitted(chroma)), None, "none")
    return Fitted(partial(_in_changed_chroma, coarse.enlarged(source, _luminance_twice).changes))


def grey_outside(viewed: Source[M], scribbles: Scribbles, boxes: Tensor) -> Scribbles:
    """Coloured scribbles in boxes (B, 1, 4) of a picture, and grey ones just outside."""
    inside, outside = (planes.flatten(2) for planes in (held(boxes, viewed.size), just_outside(boxes, viewed.size)))
    grey = outside.any(0).flatten().nonzero().squeeze(1).to(scribbles.places)
    places, back = torch.cat([scribbles.places, grey]).unique(return_inverse=True)
    own = back[: len(scribbles.places)]
    weights = outside[..., places].to(scribbles.weights)
    weights[..., own] = torch.where(inside[..., scribbles.places], scribbles.weights, weights[..., own])
    image = at(viewed, places)[0]
    shown = reduce_channels(image.unsqueeze(2), "luminance").squeeze(2).expand(-1, 3, -1).clone()
    shown[..., own] = torch.where(inside[..., scribbles.places], scribbles.shown, shown[..., own])
    return Scribbles(places, weights, image, shown)


def _grey_beyond(boxes: Tensor, coloured: Planes, pixels: Pixels) -> Tensor:
    return torch.where(in_boxes(boxes, pixels), coloured(pixels), luminance(pixels))


def _in_chroma(chroma: Planes, pixels: Pixels) -> Tensor:
    return merge_luminance(luminance(pixels), with_green(chroma(pixels)))


def _in_changed_chroma(changes: Callable[[Pixels], tuple[Tensor, Tensor]], pixels: Pixels) -> Tensor:
    return merge_luminance(luminance(pixels), with_green(changes(pixels)[0]))


def _luminance_twice(pixels: Pixels) -> Tensor:
    """Luminance, (B, 2, h, w), one plane for each of red and blue."""
    return luminance(pixels).expand(-1, 2, -1, -1)
