"""Recolouring of objects by strokes of colour. Paper: Sec. V-A, Figs. 14, 15."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph, check_same_size
from nlfilter_torch.core.precision import per_image, squarable
from nlfilter_torch.operator.options import Completion, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import RECOLOR
from nlfilter_torch.photo.looks.look_filter import acts
from nlfilter_torch.photo.picture.boxes import boxes_of, check_scribbles_in, held
from nlfilter_torch.photo.picture.colour import dot, merge_luminance, split_luminance
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.pixels import Box, M, whole_image
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, blocks_at, middles_of
from nlfilter_torch.photo.picture.source import Fitted, Pixels, Source, at
from nlfilter_torch.photo.selections.border_colours import Sides, colours_beside, refine_mask
from nlfilter_torch.photo.selections.connected import Extent
from nlfilter_torch.photo.selections.hues import pieces_of, shade
from nlfilter_torch.photo.selections.mask import ObjectEdit, Regions, background_of, boxed, fit_regions
from nlfilter_torch.photo.selections.painted import Painted

EPSILON = 1e-12  # keeps the derivative of a root finite
END_MARGIN = 0.1  # masks closer to 0 or 1 are set to 0 or 1: a faint tint far away is visible, a less soft edge is not
CERTAIN = 0.9  # share of the highest mask in a box from which on pixels surely belong to the object
ROOM = 0.8  # share of the chroma at which a channel reaches 1 that the mean of an object may have
DARKEST, LIGHTEST = 0.08, 0.92  # least share of its luminance that an object keeps, and most luminance that it gets
MOST_GAIN = 4.0  # of the shading of a dark object that becomes light: of noise, too
GREY_CHROMA = 0.05  # chroma below this counts as grey, without variations to keep


def recolor(
    image: Tensor,
    strokes: Tensor | None,
    stroke_mask: Tensor | None,
    *,
    keep: Tensor | None = None,
    box: Box | None = None,
    added: Tensor | None = None,
    removed: Tensor | None = None,
    brightness: float | Tensor = RECOLOR.defaults["brightness"],
    reach: float | Tensor = RECOLOR.defaults["reach"],
    extent: Extent = RECOLOR.defaults["extent"],
    photometric_bandwidth: float | Tensor = RECOLOR.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = RECOLOR.defaults["patch_size"],
    num_landmarks: int = RECOLOR.defaults["num_landmarks"],
    landmarks: Sampling = RECOLOR.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Recolour the objects that strokes are painted on, and similar pixels around them.

    Paper: Sec. V-A, with :func:`region_mask` in place of k-means, for any number of colours. Where hues and saturations
    around a pixel are not among those under the stroke, it stays unchanged even if its brightness and texture are
    similar. A side of the object in shade, which has its hue up to the border, takes the new colour, too, and so do its
    dark folds.

    Args:
        image: (B, 3, H, W), RGB in [0, 1].
        strokes: (B, 3, H, W), RGB, of which only hue and saturation are used if ``brightness`` is 0. A
            saturation too strong for the luminance of a region is reduced for the whole region, so that its shading
            remains. Up to 16 colours are distinguished, each with its own region.
        stroke_mask: (B, 1, H, W) in [0, 1], above 0 where painted.
        keep: (B, 1, H, W) in [0, 1], background scribbles, above 0 on pixels that stay unchanged together with similar
            ones. Strokes take precedence over it.
        box: ``(left, top, right, bottom)`` in pixels, a rectangle that holds all that takes a new colour, or a tensor
            (B, 1, 4); outside it nothing changes, see :func:`region_mask`. Without ``stroke_mask``, the object in it
            takes the mean of ``strokes`` there, which may be (B, 3, 1, 1).
        added: (B, 4, H, W), RGB and, in [0, 1], how much of it: painted by hand, takes that colour whatever is
            computed. Without other strokes, these are None.
        removed: (B, 1, H, W) in [0, 1], likewise: 1 stays unchanged. It takes precedence over ``added``.
        brightness: in [0, 1], 1 gives the object's pixels under a stroke the mean luminance of the stroke, and others
            theirs in proportion, 0 keeps the luminance of the image; highlights stay white.
        reach: in [0, 1), probability that a walk over similar pixels continues after each step; larger includes less
            similar pixels.
        extent: ``"object"`` recolours only the object under a stroke, of which narrow things may hide parts, ``"near"``
            all that is similar nearby, ``"everywhere"`` at any distance.
        photometric_bandwidth: in hundredths of Lab: 0.08 is 8 units.
        spatial_bandwidth: in pixels; None is 1.2 of the short side, ``math.inf`` no limit.
        patch_size: width of the compared patches.
        num_landmarks: M of the filter.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, 3, H, W), with the luminance of ``image`` if ``brightness`` is 0, and equal to it where a pixel is similar
        to no stroke. Differentiable in image, strokes, mask and parameters, at a fixed grouping of the colours: by hue
        and saturation, and by luminance too if ``brightness`` is above 0.

    Raises:
        TypeError, ValueError: if a tensor has another size, a mask leaves [0, 1], nothing is painted, or ``keep`` is
            painted only under the strokes in some image.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[:, 0, :, 12:] += 0.6  # the right half is reddish
        >>> strokes, painted = torch.zeros(1, 3, 24, 24), torch.zeros(1, 1, 24, 24)
        >>> strokes[:, 2], painted[..., 8:12, 16:20] = 1.0, 1.0  # blue, in its midst
        >>> blue = recolor(image, strokes, painted, num_landmarks=50)
        >>> torch.equal(blue[..., :8], image[..., :8]), bool((blue[:, 2] > blue[:, 0])[..., 14:].all())
        (True, True)
    """
    if added is not None:
        check_image(added, "added", channels=4)
    return edited(Recolor, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Recolor(ObjectEdit):
    """The edit of :func:`recolor`."""

    declared: ClassVar[Edit] = RECOLOR
    image_channels: ClassVar[int | None] = 3
    brightness: float | Tensor = RECOLOR.defaults["brightness"]

    def check_channels(self, channels: int) -> None:
        """Raise ValueError for a grey photograph."""
        if channels < 3:
            raise ValueError("recolor needs a colour photograph, got a grey one; use colorize for grey photographs")

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the new colours of the objects under the strokes."""
        RECOLOR.check(source.batch, reach=self.reach, brightness=self.brightness)
        painted = Painted.of(source, drawn, self._strokes_in_box(source, drawn))
        if painted is None:
            return Fitted(whole_image)
        matches = acts(torch.as_tensor(self.brightness), 0.0)
        shown, valid, groups = painted.grouped(source.size, matches)
        under, old = groups.means()
        brightening = Brightening.of(under, shown, self.brightness) if matches else None
        brightness = under if brightening is None else brightening.new
        colours = with_room(split_colours(shown)[1] if matches else shown, brightness)
        by_hand = groups.by_hand(source, drawn.masks.get("removed"))
        kept = list[Scribbles]()
        if painted.strokes is not None:
            kept = background_of(source, drawn.masks.get("keep"), painted.strokes, "keep")
        boxes = None
        if drawn.box is not None and painted.strokes is not None:
            boxes = boxes_of(drawn.box, source.size, source.batch, 1).expand(-1, len(groups.inside), -1)
            check_scribbles_in(boxes[:, :1], [painted.strokes], source.size, "strokes")
        selection = self.selection_in(source.size)
        if self.extent == "object":  # whose pieces may be apart, behind an arm or a strap
            selection = replace(selection, extent="near")
        objects = fit_regions(source, groups.inside, kept, selection, by_hand, boxes, alone=False)
        if self.extent == "object":
            objects = replace(objects, functions=objects.functions * _own(objects, source.size).unsqueeze(2))
        change = Recoloring(colours, old, valid, under, brightening)
        reduced, masks = change.compared(objects.reduced), objects.reduced_masks()
        shares = [refine_mask(reduced, share) for share in change.shares(masks).split(1, dim=1)]
        beside = [colours_beside(reduced, share).planes for share in shares]
        by_hue = groups.corrected_by_hue(source.size, objects.reduced, masks, shares, kept)
        return Fitted(RecoloredPixels(change, objects, beside, by_hue))

    def _strokes_in_box(self, source: Source[M], drawn: Drawn[M]) -> Scribbles | None:
        """Strokes on all that surely belongs to the object in a box, in the colour for it; None if it is painted.

        The colour is that of a mark, or the mean of ``strokes`` without a mask in the box.
        """
        shown = drawn.colours if isinstance(drawn.colours, Tensor) and drawn.colours.shape[1:2] == (3,) else None
        if drawn.box is None or "stroke_mask" in drawn.masks or (drawn.colour is None and shown is None):
            return None
        boxes = boxes_of(drawn.box, source.size, source.batch, 1)
        colour = drawn.colour
        if shown is not None:
            check_photograph(shown, "strokes", channels=3, batch=source.batch)
            if shown.shape[2:] != (1, 1):
                check_same_size(shown, source.size, "strokes", "image")
            inner = held(boxes, source.size).to(shown)
            colour = (shown * inner).sum((2, 3)) / inner.sum((2, 3))
        assert colour is not None  # for mypy
        nothing, _ = boxed(source, boxes, [], 1, "strokes")
        kept = background_of(source, drawn.masks.get("keep"), nothing[0], "keep")
        objects = fit_regions(source, nothing, kept, self.selection_in(source.size), None, boxes)
        masks = objects.reduced_masks().detach()
        certain = (masks >= CERTAIN * masks.amax((2, 3), keepdim=True)) & (masks > 0)
        places = middles_of(certain.any(0).squeeze(0), source.size)
        image, opacity = at(source, places)
        weights = certain[:, :, certain.any(0).squeeze(0)].to(image)
        colours = colour.to(image).view(-1, 3, 1).expand(source.batch, -1, len(places))
        return Scribbles(places, weights if opacity is None else weights * opacity, image, colours)


@dataclass(frozen=True, eq=False)
class RecoloredPixels:
    """The recoloured pixels of a picture.

    Attributes:
        change: of the colours, given masks.
        objects: the masks.
        beside: for each object, what :func:`colours_beside` found, in the reduced picture.
        by_hue: for each object, :func:`corrections`, likewise; none if there are no strokes on objects.
    """

    change: "Recoloring"
    objects: Regions
    beside: list[Tensor]
    by_hue: list[Tensor]

    def __call__(self, pixels: Pixels) -> Tensor:
        """Recolour pixels."""
        sides = [Sides.of(self.objects.rows(planes, pixels)) for planes in self.beside]
        finished = partial(self.objects.finished, pixels=pixels)
        by_hue = []
        for planes, scribbles in zip(self.by_hue, self.objects.scribbles if self.by_hue else [], strict=True):
            factor, shaded = self.objects.rows(planes, pixels).split(1, dim=1)
            front, back = scribbles.planes(pixels).split(1, dim=1)
            by_hue.append((torch.lerp(factor, torch.ones_like(factor), front), shaded * (1 - back)))
        return self.change(pixels.image, self.objects.computed(pixels), sides, finished, by_hue)


def _own(objects: Regions, size: tuple[int, int]) -> Tensor:
    """Which pixels (B, K, h, w) of the reduced picture belong to the object under the strokes of each colour."""
    masks, painted = objects.reduced_masks(), []
    shape = (masks.shape[-2], masks.shape[-1])
    for scribbles in objects.scribbles:
        weights = scribbles.weights[:, 0].detach()
        empty = weights.new_zeros(len(weights), shape[0] * shape[1])
        painted.append(empty.index_add(1, blocks_at(scribbles.places, size, shape), weights).unflatten(1, shape))
    return pieces_of(masks, torch.stack(painted, dim=1))


def with_room(chroma: Tensor, brightness: Tensor) -> Tensor:
    """Scale down chroma (B, K, 3) with which a pixel of the given brightness (B, K, 1) would hardly have room to white.

    If every pixel of an object had the strongest chroma that white allows, the object would look flat: lighter pixels,
    which need more chroma, would have less. The strongest chroma that black allows grows with the brightness.
    """
    limit = (1 - brightness).clamp(min=0.0) / chroma.amax(2, keepdim=True).clamp(min=EPSILON)
    return chroma * (ROOM * limit).clamp(max=1.0)


def split_colours(colours: Tensor) -> tuple[Tensor, Tensor]:
    """Split RGB colours (B, K, 3) into luminance (B, K, 1) and chroma (B, K, 3)."""
    luminance, chroma = split_luminance(colours.mT.unsqueeze(3))
    return luminance.squeeze(3).mT, chroma.squeeze(3).mT


@dataclass(frozen=True, eq=False)
class Brightening:
    """Change of the luminance of K objects towards that of their strokes.

    Darker pixels of an object than those under its stroke follow in proportion, as a surface of another colour would.
    Lighter ones do so, too, if the object becomes darker, except for highlights, which have lost the colour of the
    object: these stay white. If it becomes lighter, they approach white. Where few levels would become many, shading
    is amplified no more than :data:`MOST_GAIN` times.

    Attributes:
        old: mean luminance under the strokes, (B, K, 1).
        new: what it becomes, (B, K, 1).
        amount: the share of the whole change, (1 or B, 1, 1, 1).
    """

    old: Tensor
    new: Tensor
    amount: Tensor

    @staticmethod
    def of(old: Tensor, colours: Tensor, amount: float | Tensor) -> "Brightening":
        """Change luminance (B, K, 1) towards that of colours (B, K, 3), by a share of the change."""
        share = per_image(amount, old, 3)
        wanted = split_colours(colours)[0]
        least, most = DARKEST * old, old.clamp(min=LIGHTEST)
        return Brightening(old, old + share * (wanted.clamp(least, most) - old), share.unsqueeze(3))

    def __call__(self, number: int, luminance: Tensor, relative: Tensor) -> Tensor:
        """New luminance (B, 1, H, W) of an object with that number, whose pixels have a relative saturation."""
        old, new = (mean[:, number, :, None, None] for mean in (self.old, self.new))
        gain = (new / old.clamp(min=EPSILON)).clamp(max=MOST_GAIN)
        beyond = luminance - old
        along = new + gain * beyond
        room, left = (1 - old).clamp(min=EPSILON), (1 - new).clamp(min=EPSILON)
        place = (beyond / room).clamp(0.0, 1.0)
        slope = gain * room / left
        towards_white = new + left * slope * place / (1 + (slope - 1) * place).clamp(min=EPSILON)
        highlight = (1 - relative).clamp(0.0, 1.0)
        lighter = torch.where(gain > 1, towards_white, torch.lerp(along, new + left * place, highlight))
        return torch.where(beyond > 0, lighter, along).clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Recoloring:
    """Recolouring of an image by scribbles of K colours, given the masks of the regions.

    A pixel on a soft border is a mixture of the object and its background. Only the object's part takes the new colour,
    so that no rim of the old colour is left.

    Attributes:
        colours: chroma of the strokes, (B, K, 3).
        old: mean chroma of the image under the strokes, (B, K, 3).
        valid: which of the K colours each image has, (B, K).
        under: mean luminance of the image under the strokes, (B, K, 1).
        brightening: change of the objects' luminance; None keeps it.
    """

    colours: Tensor
    old: Tensor
    valid: Tensor
    under: Tensor
    brightening: Brightening | None = None

    def compared(self, image: Tensor) -> Tensor:
        """What is compared at the borders of an image (B, 3, H, W): chroma, or colours if luminance changes, too."""
        return split_luminance(image)[1] if self.brightening is None else image

    def shares(self, masks: Tensor) -> Tensor:
        """Return the fraction of each pixel that takes each colour, (B, K, H, W), from masks (B, K, H, W)."""
        certain = ((masks - END_MARGIN) / (1 - 2 * END_MARGIN)).clamp(0.0, 1.0)
        shares = certain * self.valid[..., None, None]
        return shares if shares.shape[1] == 1 else shares / shares.sum(1, keepdim=True).clamp(min=1.0)

    def __call__(
        self,
        pixels: Tensor,
        masks: Tensor,
        beside: list[Sides],
        finished: Callable[[Tensor], Tensor] | None = None,
        by_hue: Sequence[tuple[Tensor, Tensor]] = (),
    ) -> Tensor:
        """Recolour pixels (B, 3, H, W), given masks (B, K, H, W) and the colours on both sides of their borders.

        ``finished`` limits the shares (B, K, H, W) of the colours and paints on them, see :meth:`Regions.finished`;
        ``by_hue`` corrects each, see :meth:`corrected`.
        """
        luminance, chroma = split_luminance(pixels)
        compared = chroma if self.brightening is None else pixels  # :meth:`compared`
        shares = self.corrected(luminance, chroma, self.refined(compared, masks, beside), by_hue)
        if finished is not None:
            shares = finished(shares) * self.valid[..., None, None]
        brightness, changed, total = luminance, chroma, torch.zeros_like(luminance)
        for k in range(shares.shape[1]):
            sides, share = beside[k], shares[:, k : k + 1]
            # Colour of the object's part of a mixed pixel; inside the object, that of the pixel.
            object_colour = torch.addcmul(compared, 1 - share, sides.across)
            object_luminance, object_chroma = luminance, object_colour
            if self.brightening is not None:
                object_luminance, object_chroma = split_luminance(object_colour.clamp(0.0, 1.0))
            relative = self.relative(k, object_chroma, object_luminance)
            factor = share * relative.clamp(0.0, 1.5)
            if self.brightening is not None:
                new = self.brightening(k, object_luminance, relative)
                brightness = torch.addcmul(brightness, share, new - object_luminance)
                factor = factor * in_gamut(new, relative.clamp(0.0, 1.5) * self.colours[:, k, :, None, None])
            changed = torch.addcmul(changed, factor, self.colours[:, k, :, None, None])
            changed = torch.addcmul(changed, share, object_chroma, value=-1)
            total = total + share
        untouched = (total == 0).expand_as(pixels)
        return torch.where(untouched, pixels, merge_luminance(brightness.clamp(0.0, 1.0), changed))

    def refined(self, compared: Tensor, masks: Tensor, beside: list[Sides]) -> Tensor:
        """:meth:`shares` of masks, corrected along borders by the mixing ratio of the colours on both sides.

        ``compared`` is :meth:`compared` of the pixels.
        """
        shares, refined = self.shares(masks), []
        for k, sides in enumerate(beside):
            share = shares[:, k : k + 1]
            if self.brightening is not None:
                # A border pixel that is a tenth white on black ground is a bright rim once the white is dark.
                share = torch.lerp(share, masks[:, k : k + 1] * self.valid[:, k, None, None, None], sides.trust)
            refined.append(sides.refine(compared, share))
        return torch.cat(refined, dim=1)

    def corrected(
        self, luminance: Tensor, chroma: Tensor, shares: Tensor, by_hue: Sequence[tuple[Tensor, Tensor]]
    ) -> Tensor:
        """Shares (B, K, H, W), each times a factor (B, 1, H, W), and with shade where there is some, (B, 1, H, W)."""
        if not by_hue:
            return shares
        shares = shares * torch.cat([factor for factor, _ in by_hue], dim=1)
        shades = torch.cat(
            [
                within * shade(luminance, chroma, self.under[:, k, :, None, None], self.old[:, k, :, None, None])
                for k, (_, within) in enumerate(by_hue)
            ],
            dim=1,
        )
        free = (1 - shares.sum(1, keepdim=True)).clamp(min=0.0)
        return shares + free * self.valid[..., None, None] * shades / shades.sum(1, keepdim=True).clamp(min=1.0)

    def relative(self, number: int, chroma: Tensor, luminance: Tensor) -> Tensor:
        """Saturation (B, 1, H, W) of an object's pixels relative to that under its stroke, which the new colour takes.

        So a white highlight stays white. For a grey object it follows the luminance: shade takes less of the colour.
        """
        old = squarable(self.old[:, number])
        squared_saturation = old.square().sum(1)[:, None, None, None]
        limited_chroma = squarable(chroma)
        product = (squared_saturation * dot(limited_chroma, limited_chroma)).clamp(min=EPSILON).sqrt()
        lit = luminance / self.under[:, number, :, None, None].clamp(min=EPSILON)
        shaded = lit.clamp(max=1.0)
        if self.brightening is not None:  # then light parts take more of it, too
            shaded = torch.lerp(shaded, lit, self.brightening.amount)
        grey = GREY_CHROMA**2
        return (product + grey * shaded) / (squared_saturation + grey)


def in_gamut(luminance: Tensor, chroma: Tensor) -> Tensor:
    """Factor (B, 1, H, W) of chroma (B, 3, H, W) that keeps all channels in [0, 1], at most 1."""
    up, down = chroma.amax(1, keepdim=True).clamp(min=EPSILON), -chroma.amin(1, keepdim=True).clamp(max=-EPSILON)
    return torch.minimum((1 - luminance) / up, luminance / down).clamp(0.0, 1.0)
