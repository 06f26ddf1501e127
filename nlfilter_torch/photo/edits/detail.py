"""Detail sliders for the whole image, or for everything similar to painted regions. Paper: Figs. 12, 13."""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal, Self

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import (
    check_alpha,
    check_count,
    check_dtype,
    check_finite,
    check_positive,
    check_shape,
)
from nlfilter_torch.operator.features import blur_margin
from nlfilter_torch.operator.options import Completion, GuideChannels, Sampling
from nlfilter_torch.photo.declared.declaration import Arguments, Edit
from nlfilter_torch.photo.declared.parameters import DETAIL, MASK
from nlfilter_torch.photo.picture.boxes import boxes_of, scaled
from nlfilter_torch.photo.picture.changes import (
    VARIANCE_SIGMA,
    DetailChange,
    activity,
    blend_changes,
    change_of_mean,
    limit_by_activity,
)
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.measuring import everywhere
from nlfilter_torch.photo.picture.pixels import Box, M, corner, whole_image
from nlfilter_torch.photo.picture.regions import num_regions, resized_masks
from nlfilter_torch.photo.picture.resizing import enlarged
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Planes, Source, luminance
from nlfilter_torch.photo.picture.viewing import balance, enlarged_change, fit_change, viewed_size
from nlfilter_torch.photo.selections.by_hand import ByHand
from nlfilter_torch.photo.selections.connected import Extent
from nlfilter_torch.photo.selections.mask import RegionMask, Regions

Channels = Literal["luminance", "all"]


def enhance(
    image: Tensor,
    alpha: Tensor,
    regions: Tensor | None = None,
    *,
    negative: Tensor | None = None,
    box: Box | None = None,
    added: Tensor | None = None,
    removed: Tensor | None = None,
    outside: Tensor | None = None,
    residual: float | Tensor | None = DETAIL.defaults["residual"],
    channels: Channels = DETAIL.defaults["channels"],
    reach: float | Tensor = DETAIL.defaults["reach"],
    extent: Extent = DETAIL.defaults["extent"],
    mask_bandwidth: float | Tensor = DETAIL.defaults["mask_bandwidth"],
    threshold: float | Tensor = DETAIL.defaults["threshold"],
    limits: Limits = DETAIL.defaults["limits"],
    viewing_size: float = DETAIL.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = DETAIL.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | str | None = DETAIL.defaults["spatial_bandwidth"],
    patch_size: int = DETAIL.defaults["patch_size"],
    num_landmarks: int = DETAIL.defaults["num_landmarks"],
    landmarks: Sampling = DETAIL.defaults["landmarks"],
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "luminance",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Apply detail sliders to a photograph, or separate sliders to everything similar to each of several regions.

    Paper: eq. (12), (13). The filter compares luminance; the masks are those of :func:`region_mask`.

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
        alpha: sliders, fine to coarse: (k+1,) or (B, k+1) without regions; with regions one row for each, (K, k+1), or
            (k+1,) for all of them.
        regions: (B, K, H, W) in [0, 1], above 0 on part or all of each of K regions, like the scribbles of
            :func:`region_mask`; None edits the whole image.
        negative: (B, 1 or K, H, W) in [0, 1], above 0 on part of the background of all regions, or of each region.
        box: ``(left, top, right, bottom)`` in pixels, a rectangle that holds each region, or a tensor (B, K, 4), see
            :func:`region_mask`; it may take the place of ``regions``.
        added: (B, K, H, W) in [0, 1], painted on the masks of the regions by hand, see :func:`region_mask`; it may take
            the place of ``regions``.
        removed: (B, 1 or K, H, W) in [0, 1], likewise: pixels that belong to no region, or not to each.
        outside: sliders (k+1,) outside all regions; None leaves these pixels unchanged.
        residual: weight of the residual of the eigenvectors, see :func:`polynomial_filter`.
        channels: ``"luminance"`` keeps the colours, ``"all"`` edits red, green and blue alike.
        reach: reach of the masks, in [0, 1); larger includes less similar pixels.
        extent: of the masks, that of :func:`region_mask`.
        mask_bandwidth: photometric bandwidth of the masks, in hundredths of Lab.
        threshold: standard deviation of luminance around a pixel at which detail gets half the amplification of the
            sliders; where the deviation is smaller, detail gets less. 0 amplifies all detail alike.
        limits: ``"soft"`` keeps detail in highlights and shadows, ``"none"`` adds the change as it is and lets them
            clip.
        viewing_size: in megapixels; larger images are edited like their reduction to this size, with patches and
            bandwidths in its pixels; 0 is the size of the image.
        photometric_bandwidth: h_y of the filter, or ``"auto"``.
        spatial_bandwidth: h_x of the filter in pixels; None is a twelfth of the short side, ``"none"`` compares pixels
            regardless of their distance, so that shading counts as detail, too.
        patch_size: width of the compared patches of the filter.
        num_landmarks: M of the filter; a spatial term needs more. The masks use as many, but at most 100.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        guide_channels: what the filter compares, ``"luminance"`` or ``"all"`` channels.
        generator: source of randomness for the landmarks of filter and masks; None draws the same for every call.

    Returns:
        (B, C, H, W) in the image's dtype; values may leave [0, 1]. Differentiable in image, sliders and regions.

    Raises:
        TypeError, ValueError: if sizes differ, a region is empty, or ``alpha`` does not fit the regions.

    Example:
        >>> import torch
        >>> image = 0.2 * torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> region = torch.zeros(1, 1, 24, 24)
        >>> region[..., :6, :6] = 1
        >>> enhance(image, torch.tensor([3.0, 3.0, 4.0, 1.05]), region, num_landmarks=50).shape
        torch.Size([1, 3, 24, 24])
    """
    return edited(Detail, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Detail(PhotoEdit):
    """The edit of :func:`enhance`."""

    alpha: Tensor
    outside: Tensor | None = None
    residual: float | Tensor | None
    channels: Channels
    reach: float | Tensor
    extent: Extent = DETAIL.defaults["extent"]
    mask_bandwidth: float | Tensor
    threshold: float | Tensor
    limits: Limits
    viewing_size: float
    declared: ClassVar[Edit] = DETAIL
    relative: ClassVar[bool] = True

    @classmethod
    def of(cls, arguments: Arguments) -> Self:
        """Create the edit; a step has its sliders as a tuple."""
        alpha = arguments["alpha"]
        return super().of({**arguments, "alpha": torch.tensor(alpha) if isinstance(alpha, tuple) else alpha})

    def selection(self) -> RegionMask:
        """The masks of the regions; with a generator, both filters draw from the same state."""
        generator = self.options.generator
        options = replace(
            RegionMask.filtering,
            photometric_bandwidth=self.mask_bandwidth,
            num_landmarks=min(self.options.num_landmarks, MASK.defaults["num_landmarks"]),
            generator=generator.clone_state() if isinstance(generator, torch.Generator) else None,
        )
        return RegionMask(reach=self.reach, extent=self.extent, options=options, names=("regions", "negative"))

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the change of detail of a picture, or of its regions."""
        alpha = self.alpha if drawn.sliders is None else drawn.sliders
        outside = self.outside if drawn.outside is None else drawn.outside
        return replace(self, alpha=alpha, outside=outside)._fit(source, drawn)

    def _fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """:meth:`fit` with the sliders of the edit."""
        masks = drawn.masks
        counts = [num_regions(source, masks[name], name) for name in ("regions", "added") if name in masks]
        self._check(source.batch, drawn)
        if drawn.box is not None:
            boxes = boxes_of(drawn.box, source.size, source.batch, counts[0] if counts else None)
            drawn, counts = replace(drawn, box=boxes), [boxes.shape[1]]
        if not counts:
            return self._fit_whole(source)
        return self._fit_regions(source, drawn, region_sliders(self.alpha, counts[0]))

    def _check(self, batch: int, drawn: Drawn[M]) -> None:
        """Raise an error for an invalid setting."""
        masks = drawn.masks
        alpha, outside = self.alpha, self.outside
        check_alpha(alpha)
        check_count(self.options.num_landmarks, "num_landmarks")
        DETAIL.check(batch, channels=self.channels, limits=self.limits, viewing_size=self.viewing_size)
        DETAIL.check(batch, threshold=self.threshold, residual=self.residual)
        marked = "regions" in masks or "added" in masks or drawn.box is not None
        if not marked and (outside is not None or masks):
            name = next((name for name in ("negative", "removed") if name in masks), "outside")
            raise ValueError(f"{name} must be given together with regions, got no regions; mark the regions to edit")
        if outside is not None:
            check_shape(outside, (alpha.shape[-1],), "outside", "give as many sliders as alpha has")
            check_dtype(outside, "outside", "write 1.0 instead of 1")
            check_finite(outside, "outside")
        if marked:
            check_positive(self.mask_bandwidth, "mask_bandwidth", batch)

    @property
    def planes(self) -> Planes:
        """What is changed: luminance, or all channels."""
        return whole_image if self.channels == "all" else luminance

    def guide(self, size: tuple[int, int]) -> Guide:
        """The guide of a picture (H, W) at the viewing size, and the options of the filter."""
        return Guide(self.filter_options(size, fewer_landmarks=True), exact=self.residual is not None)

    def _detail(self, viewed: Source[M], sliders: Tensor) -> DetailChange:
        """The change of all of a picture by sliders less 1."""
        residual = None if self.residual is None else self.residual - 1
        return DetailChange.of(viewed.operator(self.guide(viewed.size)), self.planes, sliders, residual)

    def _fit_whole(self, source: Source[M]) -> Fitted:
        alpha = self.alpha
        if alpha.ndim == 2 and len(alpha) not in (1, source.batch):
            raise ValueError(
                f"alpha must have shape (k+1,), or ({source.batch}, k+1) for a row per image, got "
                f"{tuple(alpha.shape)}; select the rows"
            )
        brighter = None if alpha.ndim == 4 else (alpha - 1)[..., -1].reshape(-1, 1, 1, 1).to(source.dtype)
        return fit_change(source, self._change, self.planes, self.viewing_size, self.limits, brighter=brighter)

    def _change(self, viewed: Source[M]) -> Fitted:
        """The change of a picture at the viewing size."""
        change = self._detail(viewed, self.alpha - 1)
        if not isinstance(self.threshold, Tensor) and self.threshold == 0:
            return Fitted(change.whole)
        return self._fitted(change)

    def _fit_regions(self, source: Source[M], drawn: Drawn[M], sliders: Tensor) -> Fitted:
        masks, outside = drawn.masks, self.outside
        elsewhere = torch.zeros_like(sliders[0]) if outside is None else outside - 1
        brighter = None if outside is None else change_of_mean(torch.cat([sliders, outside[None] - 1]))
        brighter = None if brighter is None else brighter.to(source.dtype)
        regional = partial(self._change_of_regions, source, drawn, [*sliders, elsewhere])
        size = viewed_size(source.size, self.viewing_size)
        if size != source.size:
            by_hand = ByHand.of(source, masks.get("added"), masks.get("removed"), len(sliders))
            if by_hand is not None:
                viewed = source.resized(size)
                return self._fit_by_hand(source, viewed, regional(viewed), by_hand, brighter)
        return fit_change(
            source,
            lambda viewed: self._fitted(regional(viewed)),
            self.planes,
            self.viewing_size,
            self.limits,
            brighter=brighter,
        )

    def _fit_by_hand(
        self, source: Source[M], viewed: Source[M], regional: "RegionalChange", by_hand: ByHand, brighter: Tensor | None
    ) -> Fitted:
        """Fit the change of regions that are painted by hand on a picture larger than the viewing size.

        ``brighter`` is None if pixels outside all regions stay as they are.
        """
        corrected = None if brighter is None else balance(viewed, self._fitted(regional), self.limits, brighter)
        computed = replace(regional, regions=replace(regional.regions, by_hand=None))
        versions: list[Planes] = [*(regional.changes if brighter is not None else regional.changes[:-1]), computed]
        edited = [
            enlarged_change(source, viewed, self._fitted(version), self.planes, self.limits, brighter=corrected).pixels
            for version in versions
        ]
        if brighter is None:
            edited.insert(-1, whole_image)
        steps = source.size[0] / viewed.size[0], source.size[1] / viewed.size[1]
        return Fitted(BlendedByHand(edited, everywhere(viewed, Fitted(computed.regions.masks)), steps, by_hand))

    def _fitted(self, change: Planes) -> Fitted:
        """A change of detail at the viewing size."""
        return Fitted(change, self._limited, blur_margin(VARIANCE_SIGMA))

    def _change_of_regions(
        self, source: Source[M], drawn: Drawn[M], sliders: list[Tensor], viewed: Source[M]
    ) -> "RegionalChange":
        """The change of the regions of a picture at the viewing size, by a row of sliders for each and for the rest."""
        selector = self.selection()  # takes the state of the generator before the filter draws from it
        first = self._detail(viewed, sliders[0])
        if viewed.size != source.size:
            masks = {name: resized_masks(source, mask, viewed.size, name) for name, mask in drawn.masks.items()}
            box = None if drawn.box is None else scaled(torch.as_tensor(drawn.box), source.size, viewed.size)
            drawn = Drawn(masks, box=box)
        regions = selector.select(viewed, self.marks(drawn))
        return RegionalChange([replace(first, sliders=row) for row in sliders], regions)

    def _limited(self, image: Tensor, changes: Tensor, _: Inner) -> Tensor:
        return limit_by_activity(changes, activity(image), self.threshold)


def region_sliders(alpha: Tensor, count: int) -> Tensor:
    """Sliders less 1, (K, k+1), of K regions.

    Raises:
        ValueError: if ``alpha`` is neither (k+1,) nor (K, k+1).
    """
    if alpha.ndim == 1:
        return (alpha - 1).expand(count, -1)
    if alpha.ndim != 2 or len(alpha) != count:
        raise ValueError(
            f"alpha must have shape ({count}, k+1), a row of sliders for each of the regions, or (k+1,), got "
            f"{tuple(alpha.shape)}; reshape it"
        )
    return alpha - 1


@dataclass(frozen=True, eq=False)
class RegionalChange:
    """Changes of detail inside each region, and of the rest of the picture, blended by the masks of the regions."""

    changes: list[DetailChange]
    regions: Regions

    def __call__(self, pixels: Pixels) -> Tensor:
        """Added detail and the rest of the change at the given pixels."""
        return blend_changes(torch.cat([change(pixels) for change in self.changes], dim=1), self.regions.masks(pixels))


@dataclass(frozen=True, eq=False)
class BlendedByHand:
    """Versions of a picture, blended by what is painted on the masks of its regions by hand.

    So this is not reduced to the viewing size and enlarged again, which would blur it.

    Attributes:
        versions: the picture edited as inside each of K regions, as outside them, and by the computed masks.
        masks: the computed masks, (B, K, h, w), in the reduced picture.
        steps: height and width of one of its pixels, in pixels of the picture.
        by_hand: what is painted.
    """

    versions: list[Planes]
    masks: Tensor
    steps: tuple[float, float]
    by_hand: ByHand

    def __call__(self, pixels: Pixels) -> Tensor:
        """The edited pixels."""
        height, width = pixels.image.shape[-2:]
        masks = enlarged(self.masks, self.steps, corner(pixels), (height, width))
        parts = self.by_hand.parts(masks, pixels).unsqueeze(2)
        return (parts * torch.stack([version(pixels) for version in self.versions], dim=1)).sum(1)
