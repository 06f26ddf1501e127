"""Soft masks of things from scribbles on them and on what is around. Goes beyond the paper's Sec. IV.

The scribbles train a regression on the filter's covariance, see :mod:`nlfilter_torch.filtering.scribbles`, whose guide
compares colours, their surroundings and texture; local solves then lay the borders along those of the picture. All of
this is done to a picture that is reduced to about :data:`SOLVED` pixels, so that its cost hardly grows with the size.
It ends in a linear function of the colours for each place, which gives the mask of any pixel from its own colours; so
tiles are exact.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_photograph, check_positive
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.colour import LIGHTNESS, colour_guide, nearby
from nlfilter_torch.edits.components import Scribbles, scribbled_blocks
from nlfilter_torch.edits.matting import linear_mask, solve_linear, solve_mask
from nlfilter_torch.edits.parameters import MASK
from nlfilter_torch.edits.pixels import corner
from nlfilter_torch.edits.resizing import enlarged
from nlfilter_torch.edits.shared_parameters import VIEWING_SIZE
from nlfilter_torch.edits.source import Blocks, Fitted, Guide, Operator, Planes, Source, edited
from nlfilter_torch.edits.viewing import viewed_size
from nlfilter_torch.filtering.scribbles import fit_strokes
from nlfilter_torch.operator.features import blur, blur_margin, pad_border

SOLVED = 1 << 17  # pixels
VIEWED = VIEWING_SIZE.default  # megapixels, to which a larger picture is reduced first
CHROMA = 0.7  # weight of hue and saturation; that of lightness is LIGHTNESS
AROUND, GRAIN, TEXTURE = 2.0, 1.5, 3.0  # standard deviations in pixels: surroundings, grain, mean of its strength
TEXTURED = 1.5  # weight of texture
PLANES = 9  # of the guide
FLOATS = 80  # of a pixel of the reduced picture, about, beside those of its operator
SMOOTHNESS = 0.25  # of the regression
FRAME = 64  # points along the upper or left border of a picture, about
CONTRAST = 4.0  # with which a likelihood becomes a rough mask
TRUST, CERTAIN = 0.02, 1000.0  # confidence in the rough mask, and in scribbles
COMPARED = 512  # scribbled pixels, about, that the frame is compared with
ODD = 0.1  # share of the scribbled pixels that has to be like a point of the frame for this to be no background
TINY = 1e-6


MARGIN = max(blur_margin(AROUND), blur_margin(GRAIN) + blur_margin(TEXTURE))


def lab_of(image: Tensor) -> Tensor:
    """CIE Lab in hundredths, (B, 3, H, W), of a colour or grey image."""
    weighted = colour_guide(image.expand(-1, 3, -1, -1) if image.shape[1] == 1 else image)
    return torch.cat([weighted[:, :1] / LIGHTNESS, weighted[:, 1:]], dim=1)


def region_guide(image: Tensor) -> Tensor:
    """What masks compare, (B, 9, H, W): colours, those around, and the strength of grain and of its two directions."""
    lab = lab_of(image)
    lightness = lab[:, :1]
    colours = lab * lab.new_tensor([LIGHTNESS, CHROMA, CHROMA]).view(1, 3, 1, 1)
    padded = pad_border(lightness, 1)
    rows, columns = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    grain = torch.cat([lightness - blur(lightness, GRAIN), rows / 2, columns / 2], dim=1)
    strength = (blur(grain.square(), TEXTURE) + 1e-8).sqrt()  # the derivative of the root is finite
    return torch.cat([colours, blur(colours, AROUND), TEXTURED * strength], dim=1)


@full_precision
def region_mask(
    image: Tensor,
    scribbles: Tensor,
    background: Tensor | None = None,
    *,
    reach: float | Tensor = MASK.defaults["reach"],
    photometric_bandwidth: float | Tensor = MASK.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    num_landmarks: int = MASK.defaults["num_landmarks"],
    **options: Any,
) -> Tensor:
    """Soft masks of regions from scribbles on each and on what is around them.

    A regression on colour and texture tells object from background: pixels like the scribbles belong to the region,
    those like scribbles of the background do not. Points along the borders of the picture count as background, too, the
    less the more they resemble the region, so that one scribble is enough. The borders of the mask then follow the
    picture's. :func:`diffusion_mask` is the paper's mask, of all that is similar to one region.

    Args:
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        scribbles: (B, K, H, W) in [0, 1], above 0 on some or all of each of K regions; a rough mask will do. Those of
            other regions are background, where they do not overlap.
        background: (B, 1 or K, H, W) in [0, 1], above 0 on some of what is in no region, or not in that one; scribbles
            paint over it. None is no such scribble.
        reach: in [0, 1), how likely a walk over similar pixels goes on after each step; larger takes in what is less
            alike.
        photometric_bandwidth: in hundredths of Lab: 0.08 is 8 units.
        spatial_bandwidth: in pixels; None is 0.6 of the short side, ``math.inf`` no limit: all that is alike anywhere.
        num_landmarks: M of the operator.
        **options: further ones of :func:`nonlocal_operator`, such as ``generator``.

    Returns:
        (B, K, H, W) in [0, 1], about 1 on scribbles and about 0 on those of the background. Differentiable in image,
        scribbles, background and parameters.

    Raises:
        TypeError, ValueError: if a tensor has another size, leaves [0, 1], or holds no painted pixel that counts.

    Example:
        >>> image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[:, 0, 8:24, 8:24] += 0.6  # a red square
        >>> scribble = torch.zeros(1, 1, 32, 32)
        >>> scribble[..., 14:18, 12:20] = 1
        >>> mask = region_mask(image, scribble, num_landmarks=50)
        >>> bool(mask[..., 10:22, 10:22].min() > 0.8), bool(mask[..., :6, :].max() < 0.1)
        (True, True)
    """
    check_photograph(image, "image")
    return edited(
        image,
        fit_mask,
        scribbles,
        background,
        reach=reach,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        num_landmarks=num_landmarks,
        **options,
    )


def fit_mask(source: Source, scribbles: Any, background: Any = None, **options: Any) -> Fitted:
    """:func:`region_mask` for any source."""
    return Fitted(select_regions(source, scribbles, background, **options).masks)


@dataclass(frozen=True, eq=False)
class Regions:
    """Masks of K regions, for an edit that needs them.

    Attributes:
        reduced: the picture that they were found in, (B, C, h, w).
        step: rows and columns of the picture that are one of this one.
        functions: from colours to masks, (B, K, C+1, h, w), see :meth:`LinearMasks.fit`.
        scribbles: on each and on what is around it.
    """

    reduced: Tensor
    step: float
    functions: Tensor
    scribbles: list[Scribbles]

    @property
    def around(self) -> Tensor:
        """Largest weight of what is scribbled as background of each region, (B, K)."""
        return torch.stack([marked.weights[:, 1].amax(1) for marked in self.scribbles], dim=1)

    def rows(self, planes: Tensor, pixels: Any) -> Tensor:
        """The part (B, C, h, w) that some pixels have of planes of the reduced picture."""
        height, width = pixels.image.shape[-2:]
        return enlarged(planes, self.step, corner(pixels), (height, width))

    def masks(self, pixels: Any) -> Tensor:
        """The masks (B, K, h, w) of some pixels."""
        image, found = pixels.image - 0.5, []
        for functions, marked in zip(self.functions.unbind(1), self.scribbles, strict=True):
            mask = linear_mask(image, self.rows(functions, pixels)).clamp(0.0, 1.0)
            front, back = marked.planes(pixels).split(1, dim=1)
            found.append(mask * (1 - front - back) + front)
        return torch.cat(found, dim=1)

    def reduced_masks(self) -> Tensor:
        """The masks (B, K, h, w) of the reduced picture."""
        image = self.reduced - 0.5
        return torch.cat([linear_mask(image, f).clamp(0.0, 1.0) for f in self.functions.unbind(1)], dim=1)


def select_regions(
    source: Source,
    scribbles: Any,
    background: Any = None,
    *,
    names: tuple[str, str] = ("scribbles", "background"),
    **options: Any,
) -> Regions:
    """The masks of regions from scribbles in whatever form a source has these; ``names`` are theirs in errors.

    Further arguments are those of :func:`region_mask`.
    """
    if source.channels not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels, got {source.channels}; select some")
    inside = source.regions(scribbles, names[0])
    others = [] if background is None else source.regions(background, names[1])
    if len(others) not in (0, 1, len(inside)):
        raise ValueError(
            f"{names[1]} must have 1 channel or one for each of the {len(inside)} regions, got {len(others)}; "
            "add or drop some"
        )
    found = fit_regions(source, inside, others, **options)
    if others and bool((found.around.detach() <= 0).any()):
        raise ValueError(
            f"{names[1]} must hold a painted pixel outside the scribbles of each region in every image, got none; "
            "paint beside them, or leave it out"
        )
    return found


def fit_regions(
    source: Source,
    inside: list[Scribbles],
    background: list[Scribbles],
    *,
    reach: float | Tensor = MASK.defaults["reach"],
    spatial_bandwidth: float | Tensor | None = None,
    **options: Any,
) -> Regions:
    """The masks of regions from the scribbles on each, and on the background of all of them or of each; or none.

    Further arguments are those of :func:`region_mask`.
    """
    MASK["reach"].check_argument(reach, source.batch)
    count, several = len(inside), len(background) > 1
    both = [_against(inside, k, background[k : k + 1] if several else background) for k in range(count)]

    defaults = {name: MASK.defaults[name] for name in ("photometric_bandwidth", "num_landmarks")}
    options = defaults | {"patch_size": 1} | options | {"guide_channels": "all"}
    check_count(options["num_landmarks"], "num_landmarks")
    # The picture that a preview is, so that masks are found in the same pixels there and in the photograph.
    size = viewed_size(source.size, VIEWED)
    viewed = source if size == source.size else source.resized(size)
    blocks = math.ceil(math.sqrt(size[0] * size[1] / SOLVED))
    small = viewed.blocks(blocks, FLOATS + options["num_landmarks"])
    step = blocks if viewed is source else blocks * source.size[1] / size[1]
    marks = [blocks_of(marked, small, source.size[1], step) for marked in both]
    options["num_landmarks"] = min(options["num_landmarks"], small.size[0] * small.size[1])
    if not (isinstance(spatial_bandwidth, float) and spatial_bandwidth == math.inf):
        if spatial_bandwidth is not None:
            check_positive(spatial_bandwidth, "spatial_bandwidth", source.batch)
            spatial_bandwidth = spatial_bandwidth / step
        options["spatial_bandwidth"] = nearby(spatial_bandwidth, MASK["spatial_bandwidth"].share, small.size)
    operator = small.operator(Guide(options, region_guide, MARGIN, PLANES, spectral=True, sampled=True))
    places = frame_places(small.size)
    frame, colours = operator.at(places), small.colours(places)
    rough = []
    for marked in marks:
        alike = likeness(marked.image, marked.weights[:, 0], colours, options["photometric_bandwidth"])
        rough.append(_regression(small, operator, marked, frame, 1 - alike, reach)(small))
    front, back = (torch.cat([marked.planes(small)[:, k : k + 1] for marked in marks], dim=1) for k in (0, 1))
    return Regions(small.image, step, fit_borders(small.image, torch.cat(rough, dim=1), front, back), both)


def blocks_of(marked: Scribbles, small: Source, width: int, step: float) -> Scribbles:
    """Scribbles on a reduced picture: each block has the weights of the pixels scribbled on, as a share of all.

    And the mean of their colours.

    Args:
        marked: scribbles.
        small: the picture, reduced.
        width: W of the picture.
        step: rows and columns of a block.
    """
    if step == 1:
        return marked
    row, column = (
        ((at + 0.5) / step).long().clamp(max=count - 1)
        for at, count in zip((marked.places // width, marked.places % width), small.size, strict=True)
    )
    places, block = (row * small.size[1] + column).unique(return_inverse=True)
    weights = marked.weights.new_zeros(*marked.weights.shape[:2], len(places))
    weights = weights.index_add(2, block, marked.weights) / step**2
    colours = marked.colours
    if colours is not None:
        total = marked.weights.sum(1, keepdim=True)
        sums = [
            part.new_zeros(*part.shape[:2], len(places)).index_add(2, block, part) for part in (colours * total, total)
        ]
        colours = sums[0] / sums[1].clamp(min=TINY)
    return Scribbles(places, weights.clamp(max=1.0), small.colours(places), colours)


def _against(inside: list[Scribbles], number: int, background: list[Scribbles]) -> Scribbles:
    """The scribbles of a region and, as the second of two, those of all that is not in it."""
    rest = [other for k, other in enumerate(inside) if k != number] + background
    own = inside[number]
    if not rest:
        return own.weighted(torch.cat([own.weights, torch.zeros_like(own.weights)], dim=1))
    around = rest[0]
    for other in rest[1:]:
        joined = around.joined(other)
        around = joined.weighted(joined.weights.amax(1, keepdim=True))
    return own.joined(around)


def frame_places(size: tuple[int, int]) -> Tensor:
    """Numbers (n,), ascending, of pixels spread along the borders of a picture, one pixel away from them if it can."""
    height, width = size
    spacing = max(1, (height + width) // FRAME)
    top, left = min(1, height - 1), min(1, width - 1)
    rows, columns = torch.arange(top, height, spacing), torch.arange(left, width, spacing)
    lines = [(top + 0 * columns, columns), (height - 1 - top + 0 * columns, columns)]
    lines += [(rows, left + 0 * rows), (rows, width - 1 - left + 0 * rows)]
    return torch.cat([down * width + along for down, along in lines]).unique()


def likeness(scribbled: Tensor, weights: Tensor, others: Tensor, bandwidth: float | Tensor) -> Tensor:
    """How much the colours of other pixels (B, C, k) are like any of scribbled ones (B, C, n), (B, 1, k) in [0, 1].

    The spatial term has no part in it: a sky that the scribble is far from is still the same sky.

    Args:
        scribbled: colours.
        weights: (B, n), above 0 where they count.
        others: colours.
        bandwidth: photometric, of the regression.
    """
    every = max(1, scribbled.shape[2] // COMPARED)
    some, counted = (t[..., ::every] for t in (scribbled, weights.detach() > 0))
    scale = torch.as_tensor(bandwidth).to(others).reshape(-1, 1, 1)
    left, right = (lab_of(t.unsqueeze(2)).squeeze(2) for t in (others, some))
    squares = (left.unsqueeze(3) - right.unsqueeze(2)).square().mean(1) / scale.square()  # (B, k, n)
    counted = counted.to(others).unsqueeze(1)
    share = (torch.exp(-squares) * counted).sum(2) / counted.sum(2).clamp(min=1.0)
    return (share / ODD).clamp(max=1.0).unsqueeze(1)


def _regression(
    source: Source, operator: Operator, marked: Scribbles, frame: Blocks, unlike: Tensor, reach: float | Tensor
) -> Planes:
    """How likely any pixel belongs to a region: about 1 if it does, about 0 if not; not clamped.

    Args:
        source: the picture.
        operator: of it.
        marked: scribbles on the region and on what is around.
        frame: columns of pixels along the borders of the picture.
        unlike: how much these differ from the scribbles on the region, (B, 1, n).
        reach: as of :func:`region_mask`.
    """
    columns, weights = operator.at(marked.places), marked.weights
    total = weights.sum(1, keepdim=True).clamp(max=1.0)
    values = weights[:, :1] / weights.sum(1, keepdim=True).clamp(min=TINY)
    pixels = source.size[0] * source.size[1]
    fit = partial(fit_strokes, pairs=operator.pairs, pixels=pixels, reach=reach, smoothness=SMOOTHNESS)
    known = [(columns, total, values)]
    alone = bool((weights[:, 1].detach() <= 0).all())
    first = fit(lambda: scribbled_blocks(known), strength=0.0 if alone else 1.0)
    unlike = unlike * torch.cat([(1 - first(block)).clamp(0.0, 1.0).square() for block in frame()], dim=2)
    known.append((frame, unlike, torch.zeros_like(unlike)))
    fitted = fit(lambda: scribbled_blocks(known), strength=1.0)
    return operator.each(lambda found: fitted(found.factor))


def fit_borders(image: Tensor, likely: Tensor, front: Tensor, back: Tensor) -> Tensor:
    """Functions (B, K, C+1, H, W) from colours to masks, see :func:`solve_linear`.

    Args:
        image: (B, C, H, W).
        likely: how likely pixels are in the regions, (B, K, H, W).
        front: weights of the scribbles on the regions, likewise.
        back: of those on what is around.
    """
    bound = math.tanh(CONTRAST / 2)
    rough = (0.5 + torch.tanh(CONTRAST * (likely - 0.5)) / (2 * bound)).clamp(0.0, 1.0)  # 0 and 1 stay as they are
    painted = front + back
    target = (rough * TRUST + front * CERTAIN) / (TRUST + painted * CERTAIN)
    start = solve_mask(image, target, TRUST + painted * CERTAIN)
    return solve_linear(image, start, rough, front, back)
