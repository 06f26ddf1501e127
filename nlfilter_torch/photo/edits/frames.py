"""Filtering of all frames of a film by one filter fitted to some of them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import check_alpha, check_image, check_same_size, check_values
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.filtering.fitted import FittedFilter, fit_filter
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import Completion, FilterOptions, Sampling, SpatialBandwidth
from nlfilter_torch.photo.declared.parameters import DETAIL
from nlfilter_torch.photo.edits.detail import Channels
from nlfilter_torch.photo.picture.changes import activity, limit_by_activity, split_sliders
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import Balance, Limits
from nlfilter_torch.photo.picture.measuring import range_of
from nlfilter_torch.photo.picture.pixels import WorkingRange, whole_image
from nlfilter_torch.photo.picture.source import Fitted, Pixels, Planes, Source, luminance
from nlfilter_torch.photo.picture.viewing import balance, fit_change, viewed_size


def filter_frames(
    frames: Iterable[Tensor],
    alpha: Tensor,
    *,
    references: Sequence[Tensor],
    residual: float | Tensor | None = DETAIL.defaults["residual"],
    channels: Channels = DETAIL.defaults["channels"],
    threshold: float = DETAIL.defaults["threshold"],
    limits: Limits = DETAIL.defaults["limits"],
    viewing_size: float = DETAIL.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | Literal["auto"] = "auto",
    spatial_bandwidth: SpatialBandwidth | None = None,
    patch_size: int = DETAIL.defaults["patch_size"],
    num_landmarks: int = 100,
    landmarks: Sampling = DETAIL.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Iterator[Tensor]:
    """Filter the frames of a film, or any set of similar images, with one filter, so that the edit does not flicker.

    Args:
        frames: images (B, C, H, W) in [0, 1], read one at a time; with C = 3 they are RGB, and their colours are kept.
        alpha: sliders (k+1,) of :func:`polynomial_filter`.
        references: one or a few frames (1, C, H, W) of one size, representative of the film, which the filter is fitted
            to. Pixels similar to nothing in them stay unchanged.
        residual: that of :func:`polynomial_filter`.
        channels: ``"luminance"`` keeps the colours, ``"all"`` edits red, green and blue alike.
        threshold: that of :func:`enhance`.
        limits: that of :func:`enhance`.
        viewing_size: that of :func:`enhance`, in megapixels.
        photometric_bandwidth: h_y of the filter of the references' luminance, or ``"auto"``.
        spatial_bandwidth: h_x in pixels; None is no limit.
        patch_size: width of the compared patches.
        num_landmarks: M.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        An iterator over the edited frames, each computed on demand; values may leave [0, 1].

    Raises:
        TypeError, ValueError: if there is no reference, references differ in size, several of them come with a
            ``spatial_bandwidth``, or a frame is no image.

    Example:
        >>> film = [torch.rand(1, 3, 16, 20, generator=torch.Generator().manual_seed(i)) for i in range(3)]
        >>> edited = filter_frames(film, torch.tensor([2.0, 1.0]), references=film[:1], num_landmarks=20)
        >>> [frame.shape for frame in edited]
        [torch.Size([1, 3, 16, 20]), torch.Size([1, 3, 16, 20]), torch.Size([1, 3, 16, 20])]
    """
    options = FilterOptions.of(locals())
    check_alpha(alpha, dimensions=(1,))
    DETAIL.check(channels=channels)
    if not isinstance(frames, Iterable) or (isinstance(frames, Tensor) and frames.ndim == 0):
        raise TypeError(
            f"frames must be an iterable of images, got {type(frames).__name__}; pass a list or a generator"
        )
    if residual is not None:
        check_values(residual, "residual", "finite")
    _check_references(references, options)
    DETAIL.check(limits=limits, threshold=threshold, viewing_size=viewing_size)
    # References are stacked vertically to one image, at the cost of a few patches across the seams.
    viewed = viewed_size((references[0].shape[-2], references[0].shape[-1]), viewing_size)
    stacked = torch.cat([InMemory(f.to(working_dtype(f))).resized(viewed).image for f in references], dim=2)
    working = range_of(InMemory(stacked))
    stacked = stacked if working is None else working.seen(stacked)
    grey = reduce_channels(stacked, "luminance")
    operator = operator_from_guide(grey, options)
    fitted = fit_filter(operator, stacked if channels == "all" else grey, order=alpha.shape[-1] - 1)
    planes = whole_image if channels == "all" else luminance
    change = FrameChange(fitted, planes, alpha, residual, threshold)
    edit = FrameEdit(change, InMemory(stacked), limits, viewing_size, working)
    return map(edit, frames)


def _check_references(references: Sequence[Tensor], options: FilterOptions) -> None:
    """Raise unless these are frames to which a filter can be fitted."""
    if not isinstance(references, Sequence):
        raise TypeError(f"references must be a list of frames, got {type(references).__name__}; wrap it in a list")
    if len(references) == 0:
        raise ValueError("references must hold at least one frame, got none; pass the first of the film")
    if len(references) > 1 and options.spatial_bandwidth is not None:
        raise ValueError(
            f"references must hold a single frame if spatial_bandwidth is given, got {len(references)}; "
            "pass one frame, or no spatial_bandwidth"
        )
    for frame in references:
        check_image(frame, "references", batch=1)
        check_same_size(frame, (references[0].shape[-2], references[0].shape[-1]), "references", "first one")


@dataclass(frozen=True, eq=False)
class FrameChange:
    """The change of detail of a frame by a filter fitted to references."""

    fitted: FittedFilter
    planes: Planes
    alpha: Tensor
    residual: float | Tensor | None
    threshold: float

    def __call__(self, source: Source[Tensor]) -> Fitted:
        """Fit the change to a frame."""
        return Fitted(self._changes, self._limited)

    def _changes(self, pixels: Pixels) -> Tensor:
        """Added detail and the rest of the change."""
        before, guide = self.planes(pixels), luminance(pixels)
        weights = (None, None) if self.residual is None else (0.0, self.residual - 1)
        halves = zip(split_sliders(self.alpha - 1), weights, strict=True)
        return torch.cat([self.fitted(before, half, guide, residual=weight) for half, weight in halves], dim=1)

    def _limited(self, image: Tensor, changes: Tensor, _: Inner) -> Tensor:
        return limit_by_activity(changes, activity(image), self.threshold)


class FrameEdit:
    """The edit of single frames.

    All frames share the balance of the references, and the range in which they are seen, if it is not their own: if
    each had its own, the brightness of the film would flicker.
    """

    def __init__(
        self,
        change: FrameChange,
        references: InMemory,
        limits: Limits,
        viewing_size: float,
        working: WorkingRange | None = None,
    ) -> None:
        self.change, self.references, self.limits, self.viewing_size = change, references, limits, viewing_size
        self.working = working
        self._differentiable = change.alpha.requires_grad  # a gradient needs a graph for each frame
        self._constant = None if self._differentiable else self._balance()

    def _balance(self) -> Balance | None:
        brighter = self.change.alpha[-1] - 1
        return balance(self.references, self.change(self.references), self.limits, brighter)

    def __call__(self, frame: Tensor) -> Tensor:
        """Edit a frame (B, C, H, W)."""
        check_image(frame, "frames")
        image = frame.to(working_dtype(frame))
        source = InMemory(image if self.working is None else self.working.seen(image))
        brighter = self._balance() if self._differentiable else self._constant
        planes = self.change.planes
        fitted = fit_change(source, self.change, planes, self.viewing_size, self.limits, brighter=brighter)
        result = source.all(fitted)
        return (result if self.working is None else self.working.edited(image, result)).to(frame.dtype)
