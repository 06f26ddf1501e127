"""Soft object masks from foreground and background scribbles. Goes beyond the paper's Sec. IV.

A regression with the filter's covariance (:mod:`nlfilter_torch.filtering.scribbles`) says what is similar in colour,
surrounding colour and texture. Points that an even area, such as a sky, links to a scribble count as scribbled, too. A
model of the object (:mod:`nlfilter_torch.photo.selections.object_model`) joins this with mixtures of colours of both
sides and distances along the picture, and cuts the object out, as a rough mask, with the help of a small network
(:mod:`nlfilter_torch.photo.selections.object_network`) where only what is connected is meant. Closed-form matting
(:mod:`nlfilter_torch.photo.selections.matting`) then aligns its borders with those of the picture. All
run on a copy reduced to about :data:`SOLVED_PIXELS` pixels, so the cost hardly grows with
the size of the picture. The result is a linear function of the colour for each place, which gives the mask of any pixel
from its own colour; results in tiles are therefore exact.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, cast

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_values
from nlfilter_torch.core.workers import single_threaded, threads_for
from nlfilter_torch.operator.options import Completion, FilterOptions, Sampling, SpatialBandwidth
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.declared.shared_parameters import VIEWING_SIZE
from nlfilter_torch.photo.picture.boxes import boxes_of, check_scribbles_in, held, in_boxes, just_outside, scaled
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import InMemory, edited, in_blocks
from nlfilter_torch.photo.picture.measuring import shrunk
from nlfilter_torch.photo.picture.pixels import Box, M, Pixels, corner
from nlfilter_torch.photo.picture.regions import num_regions, read_regions
from nlfilter_torch.photo.picture.resizing import enlarged
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, parts_in_blocks
from nlfilter_torch.photo.picture.source import Fitted, Reduced, Source, at, kept, luminance
from nlfilter_torch.photo.picture.viewing import viewed_size
from nlfilter_torch.photo.selections.by_hand import ByHand, check_drawn
from nlfilter_torch.photo.selections.connected import Extent, connected, without_haze
from nlfilter_torch.photo.selections.matting import linear_mask, linear_models, solve_linear
from nlfilter_torch.photo.selections.rough_mask import RoughMasks
from nlfilter_torch.photo.selections.scribbled_colours import EPSILON, SOLVED_PIXELS, trimap_share
from nlfilter_torch.photo.selections.stray import without_strays

VIEWED = VIEWING_SIZE.default_number  # megapixels; larger pictures are first reduced to this size
FLOATS_PER_PIXEL = 80  # estimated working memory per pixel of the reduced picture, in addition to its operator
ODDS, STEEPNESS = 1.5, 1.4  # of the curve from the solution along borders, too low halfway, to masks
MOST_WAITING = 2  # threads: operations on so few pixels are not worth dividing between two


def region_mask(
    image: Tensor,
    scribbles: Tensor | None,
    background: Tensor | None = None,
    *,
    box: Box | None = None,
    added: Tensor | None = None,
    removed: Tensor | None = None,
    reach: float | Tensor = MASK.defaults["reach"],
    extent: Extent = MASK.defaults["extent"],
    photometric_bandwidth: float | Tensor = MASK.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = 1,
    num_landmarks: int = MASK.defaults["num_landmarks"],
    landmarks: Sampling = MASK.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Soft object masks from foreground and background scribbles.

    A regression on colour and texture, mixtures of the colours of both sides, and distances along the picture to the
    scribbles separate the two, and the cut between them follows borders of the picture. With the extent ``"object"``, a
    small trained network corrects the odds of the cut, above all in boxes. An even area with a scribble,
    such as a sky, belongs to the region as a whole. Points along the borders of the picture also count as background
    unless they resemble the region or are part of such an area, so one scribble is enough. The borders of the mask are
    then aligned with those of the picture. Away from all that is selected by half or more, masks are 0 where they would
    be below 0.05, and less than computed up to 0.1. Specks that are smaller than the scribbles and not connected with
    one are left out.
    Where a scribble that is at least three times as long as wide leaves its object, it does not count: at most 30 % of
    it, in one or two pieces of a very different colour, that no other scribble is meant for.
    :func:`diffusion_mask` is the paper's mask, which selects everything similar to one region.

    Args:
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        scribbles: (B, K, H, W) in [0, 1], above 0 on part or all of each of K regions; a rough mask is fine. Exactly 0
            elsewhere: pixels with faint scribbles count as parts of the region too. Scribbles of other regions are
            background, except where they overlap. None computes no masks, unless there is a ``box``: they are
            ``added``.
        background: (B, 1 or K, H, W) in [0, 1], above 0 on part of the background of all regions or of each;
            ``scribbles`` take precedence. None means no background scribbles.
        box: ``(left, top, right, bottom)`` in pixels: a rectangle that holds the object of every region, for which it
            may take the place of ``scribbles``; or a tensor (B, K, 4), one for each region. What lies outside is
            background, where masks are exactly 0, and so are scribbles there; pixels just outside tell what the
            background looks like. A box that is the whole picture says nothing.
        added: (B, K, H, W) in [0, 1], painted on the masks by hand: where it is 1, the mask of that region is 1,
            whatever is computed, and those of the others are 0. A region without scribbles is what is added to it.
        removed: (B, 1 or K, H, W) in [0, 1], likewise: where it is 1, masks are 0. It takes precedence over ``added``.
        reach: in [0, 1), probability that a random walk over similar pixels continues after each step; larger values
            include less similar pixels.
        extent: ``"object"`` selects only what is connected with a scribble of it, ``"near"`` also what is similar and
            nearby, ``"everywhere"`` what is similar at any distance, specks included.
        photometric_bandwidth: in hundredths of Lab: 0.08 is 8 units.
        spatial_bandwidth: in pixels; None is 0.3 of the short side, ``math.inf`` no limit: similar pixels anywhere.
        patch_size: width of the compared patches.
        num_landmarks: M of the operator.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, K, H, W) in [0, 1], about 1 on scribbles and about 0 on those of the background. Differentiable in image,
        scribbles, background, parameters, and in what is added and removed.

    Raises:
        TypeError, ValueError: if a tensor has another size, leaves [0, 1], or has no painted pixel that no other
            scribble overrides; if a box does not lie in the picture, or most of the scribbles do not lie in it.

    Example:
        >>> image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[:, 0, 8:24, 8:24] += 0.6  # a red square
        >>> scribble = torch.zeros(1, 1, 32, 32)
        >>> scribble[..., 14:18, 12:20] = 1
        >>> mask = region_mask(image, scribble, num_landmarks=50)
        >>> bool(mask[..., 10:22, 10:22].min() > 0.8), bool(mask[..., :6, :].max() < 0.1)
        (True, True)
    """
    return edited(RegionMask, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionMask(PhotoEdit):
    """The settings of :func:`region_mask`, which other edits use to select objects.

    Attributes:
        names: of the scribbles and of those on the background, in errors.
        grey: whether only the luminance of the picture and of its pixels under scribbles counts.
    """

    declared: ClassVar[Edit] = MASK
    relative: ClassVar[bool] = True
    gives_picture: ClassVar[bool] = False
    filtering: ClassVar[FilterOptions] = FilterOptions(patch_size=1, guide_channels="all")
    reach: float | Tensor
    extent: Extent = MASK.defaults["extent"]
    names: tuple[str, str] = ("scribbles", "background")
    grey: bool = False

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the masks of scribbled regions."""
        return Fitted(self.select(source, drawn).masks)

    def selection(self) -> "RegionMask":
        """The masks themselves."""
        return self

    def select(self, source: Source[M], drawn: Drawn[M]) -> "Regions":
        """Compute the masks of regions from scribbles in the form that the source takes, under its own names."""
        if source.channels not in (1, 3):
            raise ValueError(f"image must have 1 or 3 channels, got {source.channels}; select 1 or 3")
        scribbles, background, added = (drawn.masks.get(name) for name in ("scribbles", "background", "added"))
        check_drawn(scribbles, added, self.names[0], drawn.box)
        needed = added is None and drawn.box is None
        inside = [] if scribbles is None else read_regions(source, scribbles, self.names[0], needed=needed)
        count = len(inside) or (None if added is None else num_regions(source, added, "added"))
        inside, boxes = boxed(source, drawn.box, inside, count, self.names[0])
        by_hand = ByHand.of(source, added, drawn.masks.get("removed"), len(inside) or None)
        outside = [] if background is None else read_regions(source, background, self.names[1])
        if len(outside) not in (0, 1, len(inside)):
            raise ValueError(
                f"{self.names[1]} must have 1 channel or one for each of the {len(inside)} regions, got "
                f"{len(outside)}; add or drop some"
            )
        if not inside:
            outside = []
        regions = fit_regions(source, inside, outside, self, by_hand, boxes)
        if outside and by_hand is None and bool((regions.background_weights.detach() <= 0).any()):
            raise ValueError(
                f"{self.names[1]} must hold a painted pixel outside the scribbles of each region in every image, got "
                "none; paint outside them, or omit it"
            )
        return regions


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectEdit(PhotoEdit):
    """An edit of objects that scribbles mark; the fields and the options of the filter are those of their mask."""

    filtering: ClassVar[FilterOptions] = RegionMask.filtering
    reach: float | Tensor
    extent: Extent = MASK.defaults["extent"]

    def selection(self) -> RegionMask:
        """The masks of the objects, without the default of the spatial bandwidth, which depends on the size."""
        options = replace(self.options, patch_size=RegionMask.filtering.patch_size)
        return RegionMask(reach=self.reach, extent=self.extent, options=options)

    def selection_in(self, size: tuple[int, int]) -> RegionMask:
        """The masks of the objects in a picture (H, W)."""
        return RegionMask(reach=self.reach, extent=self.extent, options=self.filter_options(size))


@dataclass(frozen=True, eq=False)
class Regions:
    """Masks of K regions, as other edits use them: computed ones, with what is painted by hand on them.

    Attributes:
        reduced: the reduced picture in which the masks were computed, (B, C, h, w) in [0, 1].
        steps: height and width of a pixel of ``reduced``, in pixels of the picture.
        functions: linear functions from colours in [0, 1] to masks, (B, K, C+1, h, w), see :meth:`LinearMasks.fit`.
        scribbles: for each region, weights on the region and on its background.
        by_hand: what is painted on the masks, or None.
        boxes: rectangles that hold the objects, (B, K, 4) in pixels of the picture, or None.
    """

    reduced: Tensor
    steps: tuple[float, float]
    functions: Tensor
    scribbles: list[Scribbles]
    by_hand: ByHand | None = None
    boxes: Tensor | None = None

    @property
    def background_weights(self) -> Tensor:
        """Largest weight of a background scribble of each region, (B, K)."""
        return torch.stack([scribbles.weights[:, 1].amax(1) for scribbles in self.scribbles], dim=1)

    def rows(self, planes: Tensor, pixels: Pixels) -> Tensor:
        """Planes of the reduced picture, enlarged to the given pixels, (B, C, h, w)."""
        height, width = pixels.image.shape[-2:]
        return enlarged(planes, self.steps, corner(pixels), (height, width))

    def masks(self, pixels: Pixels) -> Tensor:
        """Masks (B, K, h, w) of the given pixels."""
        return self.finished(self.computed(pixels), pixels)

    def finished(self, masks: Tensor, pixels: Pixels) -> Tensor:
        """Computed masks (B, K, h, w) of the given pixels: 0 outside the boxes, and with what is painted by hand."""
        if self.boxes is not None:
            masks = torch.where(in_boxes(self.boxes, pixels), masks, 0.0)
        return masks if self.by_hand is None else self.by_hand.over(masks, pixels)

    def computed(self, pixels: Pixels) -> Tensor:
        """Masks (B, K, h, w) of the given pixels as they are computed, see :meth:`finished`."""
        seen = luminance(pixels) if self.reduced.shape[1] == 1 else pixels.image
        image, masks = seen.clamp(0.0, 1.0) - 0.5, []
        for functions, scribbles in zip(self.functions.unbind(1), self.scribbles, strict=True):
            mask = calibrated(linear_mask(image, self.rows(functions, pixels)))
            front, back = scribbles.planes(pixels).split(1, dim=1)
            masks.append(mask * (1 - front - back) + front)
        return torch.cat(masks, dim=1)

    def selected(self, source: Source[M]) -> Tensor:
        """Masks (B, K, h, w) of the picture, reduced, with what is painted on them by hand."""
        if self.by_hand is None:
            return self.reduced_masks()
        return shrunk(source, self.masks, (self.reduced.shape[-2], self.reduced.shape[-1]))

    def reduced_masks(self) -> Tensor:
        """Computed masks (B, K, h, w) of the reduced picture."""
        image = self.reduced - 0.5
        masks = [calibrated(linear_mask(image, functions)) for functions in self.functions.unbind(1)]
        if self.boxes is None:
            return torch.cat(masks, dim=1)
        rows, columns = self.reduced.shape[-2:]
        size = round(rows * self.steps[0]), round(columns * self.steps[1])
        boxes = scaled(self.boxes, size, (rows, columns)).to(self.reduced.device)
        return torch.where(held(boxes, (rows, columns)), torch.cat(masks, dim=1), 0.0)


def background_of(source: Source[M], mask: M | None, inside: Scribbles, name: str) -> list[Scribbles]:
    """Read scribbles on the background of objects, if there is a mask of them.

    Raises:
        ValueError: if in any image all of them lie under those on the objects; the message calls them ``name``.
    """
    if mask is None:
        return []
    background = source.scribbles(mask, None, name, needed=False)
    free = (inside.joined(background).weights[:, -1] > 0).any(1)
    if bool((background.painted & ~free).any()):
        raise ValueError(
            f"{name} must hold a painted pixel outside the scribbles on the object, got only pixels under them; "
            "paint outside them, or omit it"
        )
    return [background]


def boxed(
    source: Source[M], box: Box | None, inside: list[Scribbles], count: int | None, name: str
) -> tuple[list[Scribbles], Tensor | None]:
    """The scribbles on each region, and the boxes (B, K, 4) that hold them, or None; without scribbles, empty ones.

    Args:
        source: the picture.
        box: as a user gives it.
        inside: scribbles on each of ``count`` regions, or none at all.
        count: of regions; None is that of the boxes.
        name: of the scribbles, in errors.

    Raises:
        TypeError, ValueError: if the boxes do not suit the picture, or the scribbles.
    """
    if box is None:
        return inside, None
    boxes = boxes_of(box, source.size, source.batch, count)
    check_scribbles_in(boxes, inside, source.size, name)
    if not inside:
        nowhere, _ = at(source, torch.zeros(0, dtype=torch.long))
        inside = [Scribbles(torch.zeros(0, dtype=torch.long), nowhere[:, :1], nowhere)] * boxes.shape[1]
    return inside, boxes


def fit_regions(
    source: Source[M],
    inside: list[Scribbles],
    background: list[Scribbles],
    settings: RegionMask,
    by_hand: ByHand | None = None,
    boxes: Tensor | None = None,
    *,
    alone: bool = True,
) -> Regions:
    """Compute the masks of regions from scribbles on each, and on the background: none, for all, or for each.

    With ``boxes`` (B, K, 4), in pixels of the picture, there may be no scribbles on a region; see :func:`boxed`.
    Without either, its masks are 0, except for what is painted by hand; also with a box, if this is the whole picture
    or does not count ``alone``.
    """
    MASK.check(source.batch, reach=settings.reach, extent=settings.extent)
    if by_hand is None:
        return _computed_regions(source, inside, background, settings, boxes=boxes)
    count = by_hand.count
    marked = [drawn.painted for drawn in inside]
    if boxes is not None and alone:
        whole = boxes.new_tensor([0, 0, source.size[1], source.size[0]])
        by_box = (boxes != whole).any(2) | torch.tensor(by_hand.added is None)
        marked = [painted | own.to(painted.device) for painted, own in zip(marked, by_box.unbind(1), strict=True)]
    numbers = [k for k, images in enumerate(marked) if bool(images.any())]
    if numbers:
        opposed = [background[k] for k in numbers] if len(background) > 1 else background
        images = torch.stack([marked[k] for k in numbers], dim=1)
        own = None if boxes is None else boxes[:, numbers]
        regions = _computed_regions(source, [inside[k] for k in numbers], opposed, settings, images, own)
        reduced, steps = regions.reduced, regions.steps
    else:
        small, steps = _reduced(source, FLOATS_PER_PIXEL)
        reduced = small.image.clamp(0.0, 1.0)
    nowhere = reduced.flatten(2)[..., :0]
    scribbles = [Scribbles(nowhere[0, 0].long(), nowhere[:, :1].expand(-1, 2, -1), nowhere)] * count
    functions = list(reduced.new_zeros(count, len(reduced), reduced.shape[1] + 1, *reduced.shape[2:]))
    for place, number in enumerate(numbers):
        functions[number], scribbles[number] = regions.functions[:, place], regions.scribbles[place]
    return Regions(reduced, steps, torch.stack(functions, dim=1), scribbles, by_hand, boxes)


def _computed_regions(
    source: Source[M],
    inside: list[Scribbles],
    background: list[Scribbles],
    settings: RegionMask,
    marked: Tensor | None = None,
    boxes: Tensor | None = None,
) -> Regions:
    """:func:`fit_regions` without what is painted by hand.

    ``marked`` (B, K) tells which images have scribbles on each region; None is all of them, or those without have a
    box.
    """
    inside, background = ([without_strays(drawn, source.size) for drawn in side] for side in (inside, background))
    several = len(background) > 1
    scribbles = [_against(inside, k, background[k : k + 1] if several else background) for k in range(len(inside))]
    options = settings.options
    check_values(options.photometric_bandwidth, "photometric_bandwidth", "positive", source.batch)
    check_count(options.num_landmarks, "num_landmarks")
    small, steps = _reduced(source, FLOATS_PER_PIXEL + options.num_landmarks)
    if settings.grey and small.channels > 1:
        small = kept(small, "luminance", [], small.like, luminance(small), small.weights)
    everywhere = settings.extent == "everywhere"
    distance = math.inf if everywhere else options.spatial_bandwidth
    options = replace(
        options,
        spatial_bandwidth=_nearness(distance, source.batch, steps, small.size),
        num_landmarks=min(options.num_landmarks, small.size[0] * small.size[1]),
    )
    threads = threads_for(small.image)
    with single_threaded(threads if threads <= MOST_WAITING else 1):
        limits = None if boxes is None else scaled(boxes, source.size, small.size).to(small.image)
        rough = RoughMasks.of(small, options, settings.reach, settings.extent, limits)
        counted = scribbles if marked is None or boxes is not None else list(map(_filled, scribbles, marked.unbind(1)))
        reduced = [blocks_of(drawn, small, source.size, steps) for drawn in counted]
        if limits is not None:
            reduced = [opposed_outside(drawn, limits[:, k : k + 1], small) for k, drawn in enumerate(reduced)]
        image = small.image.clamp(0.0, 1.0)  # a far brighter pixel of a float file would upset the linear functions
        masks = torch.cat([rough.mask(number, drawn) for number, drawn in enumerate(reduced)], dim=1)
        front, back = torch.stack([drawn.planes(small) for drawn in reduced], dim=2).unbind(1)
        drawn = [masks, front, back]
        functions = kept(small, "borders", drawn, fit_borders, small, image, *drawn)
    if marked is not None:
        functions = functions * marked[:, :, None, None, None]
    regions = Regions(image, steps, functions, scribbles, boxes=boxes)
    if limits is not None:  # without a scribble, all that is found in a box belongs to the object
        front = torch.where(front.amax((2, 3), keepdim=True) > 0, front, held(limits, small.size).to(front))
    masks = regions.reduced_masks()
    if settings.extent == "object":
        belongs = connected(masks, front).to(masks)
    else:
        belongs = without_haze(masks, front, front.sum((2, 3)) * (not everywhere))
    return replace(regions, functions=functions * belongs.unsqueeze(2))


def _filled(scribbles: Scribbles, marked: Tensor) -> Scribbles:
    """Two planes of scribbles, with some on the region in images (B,) that have none: means of none are undefined."""
    everywhere = scribbles.weights.new_tensor((1.0, 0.0)).view(1, 2, 1)
    return scribbles.weighted(torch.where(marked.view(-1, 1, 1), scribbles.weights, everywhere))


def _reduced(source: Source[M], floats: int) -> tuple[InMemory, tuple[float, float]]:
    """The reduced picture that masks are computed in, and height and width of one of its pixels.

    It is reduced by way of the size of a preview, so that masks are the same in a preview and in the photograph.
    ``floats`` are the numbers per pixel that there must be room for.
    """
    size = viewed_size(source.size, VIEWED)
    viewed = source if size == source.size else source.resized(size)
    side = math.ceil(math.sqrt(size[0] * size[1] / SOLVED_PIXELS))
    small = in_blocks(viewed, side, floats)
    return small, (source.size[0] / small.size[0], source.size[1] / small.size[1])


def fit_borders(small: Reduced, image: Tensor, rough: Tensor, front: Tensor, back: Tensor) -> Tensor:
    """Linear functions (B, K, C+1, H, W) from colours to masks that follow the borders of a picture.

    Args:
        small: the reduced picture, which keeps its models.
        image: the same with values in [0, 1], (B, C, H, W).
        rough: rough masks of the regions, (B, K, H, W).
        front: weights of the scribbles on the regions, (B, K, H, W).
        back: weights of the scribbles on their background, (B, K, H, W).
    """
    trimap = trimap_share(torch.stack([front, back], dim=2).flatten(3))
    return solve_linear(kept(small, "models", [], linear_models, image), rough, front, back, trimap)


def _nearness(
    bandwidth: SpatialBandwidth | str | None, batch: int, steps: tuple[float, float], size: tuple[int, int]
) -> SpatialBandwidth | None:
    """Spatial bandwidth in pixels of the reduced picture (h, w), from that in pixels of the picture."""
    if isinstance(bandwidth, float) and bandwidth == math.inf:
        return None
    if bandwidth is not None:
        check_values(bandwidth, "spatial_bandwidth", "positive", batch)
        bandwidth = cast(float | Tensor, bandwidth) / math.sqrt(steps[0] * steps[1])
    return MASK["spatial_bandwidth"].distance(bandwidth, size)


def blocks_of(scribbles: Scribbles, small: Source[M], size: tuple[int, int], steps: tuple[float, float]) -> Scribbles:
    """Scribbles on the reduced picture; weight and colour of a block are the means of its pixels.

    Args:
        scribbles: on the picture.
        small: the reduced picture.
        size: (H, W) of the picture.
        steps: height and width of a block, in pixels.
    """
    if steps == (1, 1):
        return scribbles
    parts = parts_in_blocks(scribbles.places, size, small.size)
    places, blocks = torch.cat([block for block, _ in parts]).unique(return_inverse=True)
    shares = torch.cat([share for _, share in parts])
    add = partial(_added, blocks, shares.to(scribbles.weights), len(places))
    weights = add(scribbles.weights) / (steps[0] * steps[1])
    colours = scribbles.colours
    if colours is not None:
        total = scribbles.weights.sum(1, keepdim=True)
        colours = add(colours * total) / add(total).clamp(min=EPSILON)
    return Scribbles(places, weights.clamp(max=1.0), at(small, places)[0], colours)


def opposed_outside(scribbles: Scribbles, boxes: Tensor, small: Reduced) -> Scribbles:
    """Two planes of scribbles, on a region and on its background, with pixels just outside its box on the background.

    Args:
        scribbles: on the reduced picture; what lies outside the box does not count.
        boxes: (B, 1, 4), in its pixels.
        small: the reduced picture.
    """
    inside, outside = held(boxes, small.size), just_outside(boxes, small.size)
    front, back = scribbles.planes(small).split(1, dim=1)
    back = torch.where(inside, back, outside.to(back))
    return scribbles.repainted(torch.cat([torch.where(inside, front, 0.0), back], dim=1), small.image)


def _added(blocks: Tensor, shares: Tensor, count: int, values: Tensor) -> Tensor:
    """Sums (B, C, count) of the shares of values (B, C, n) in blocks; both are repeated for each part of a pixel."""
    repeated = values.repeat(1, 1, len(blocks) // max(values.shape[2], 1)) * shares
    return values.new_zeros(*values.shape[:2], count).index_add(2, blocks, repeated)


def _against(inside: list[Scribbles], number: int, background: list[Scribbles]) -> Scribbles:
    """Two planes of scribbles: on one region, and on everything outside it."""
    rest = [other for k, other in enumerate(inside) if k != number] + background
    own = inside[number]
    if not rest:
        return own.weighted(torch.cat([own.weights, torch.zeros_like(own.weights)], dim=1))
    around = rest[0]
    for other in rest[1:]:
        joined = around.joined(other)
        around = joined.weighted(joined.weights.amax(1, keepdim=True))
    return own.joined(around)


def calibrated(mask: Tensor) -> Tensor:
    """Mask of a solution along borders: a curve on which 0 and 1 stay as they are."""
    mask = mask.clamp(0.0, 1.0)
    inside, outside = ODDS * mask**STEEPNESS, (1 - mask) ** STEEPNESS
    return inside / (inside + outside)
