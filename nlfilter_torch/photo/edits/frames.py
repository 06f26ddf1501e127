"""Filtering of all frames of a film by one filter fitted to some of them."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_alpha, check_image, check_photograph, check_same_size, check_values
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.filtering.fitted import fit_filter
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import OperatorOptions
from nlfilter_torch.photo.declared.parameters import DETAIL
from nlfilter_torch.photo.picture.changes import activity, limit_by_activity, split_sliders
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import Balance, Limits
from nlfilter_torch.photo.picture.source import Fitted, Pixels, Source, luminance
from nlfilter_torch.photo.picture.viewing import balance, fit_change, viewed_size


def filter_frames(
    frames: Iterable[Tensor],
    alpha: Tensor,
    *,
    references: Sequence[Tensor],
    residual: float | Tensor | None = DETAIL.defaults["residual"],
    channels: str = DETAIL.defaults["channels"],
    threshold: float = DETAIL.defaults["threshold"],
    limits: Limits = DETAIL.defaults["limits"],
    viewing_size: float = DETAIL.defaults["viewing_size"],
    **options: Any,
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
        **options: options of :func:`nonlocal_operator` for the luminance of the references.

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
    check_alpha(alpha, dimensions=(1,))
    DETAIL.check(channels=channels)
    if not isinstance(references, Sequence):
        raise TypeError(f"references must be a list of frames, got {type(references).__name__}; wrap it in a list")
    if not isinstance(frames, Iterable) or (isinstance(frames, Tensor) and frames.ndim == 0):
        raise TypeError(
            f"frames must be an iterable of images, got {type(frames).__name__}; pass a list or a generator"
        )
    if residual is not None:
        check_values(residual, "residual", "finite")
    if len(references) == 0:
        raise ValueError("references must hold at least one frame, got none; pass the first of the film")
    if len(references) > 1 and options.get("spatial_bandwidth") is not None:
        raise ValueError(
            f"references must hold a single frame if spatial_bandwidth is given, got {len(references)}; "
            "pass one frame, or no spatial_bandwidth"
        )
    for frame in references:
        check_photograph(frame, "references", batch=1)
        check_same_size(frame, (references[0].shape[-2], references[0].shape[-1]), "references", "first one")
    DETAIL.check(limits=limits, threshold=threshold, viewing_size=viewing_size)
    # References are stacked vertically to one image, at the cost of a few patches across the seams.
    viewed = viewed_size((references[0].shape[-2], references[0].shape[-1]), viewing_size)
    stacked = torch.cat([InMemory(f.to(working_dtype(f))).resized(viewed).image for f in references], dim=2)
    grey = reduce_channels(stacked, "luminance")
    filtered = stacked if channels == "all" else grey
    fitted = fit_filter(operator_from_guide(grey, OperatorOptions(**options)), filtered, order=alpha.shape[-1] - 1)
    planes = (lambda pixels: pixels.image) if channels == "all" else luminance

    def change(source: Source) -> Fitted:
        def of(pixels: Pixels) -> Tensor:
            before, guide = planes(pixels), luminance(pixels)

            def changed(sliders: Tensor, weight: float | Tensor | None) -> Tensor:
                return fitted(before, sliders, guide, residual=weight)

            added, rest = split_sliders(alpha - 1)
            if residual is None:
                return torch.cat([changed(added, None), changed(rest, None)], dim=1)
            return torch.cat([changed(added, 0.0), changed(rest, residual - 1)], dim=1)

        return Fitted(of, lambda image, found, _: limit_by_activity(found, activity(image), threshold))

    whole = InMemory(stacked)

    def shared_balance() -> Balance | None:
        """The balance of all frames; if each had its own, the brightness of the film would flicker."""
        return balance(whole, change(whole), limits, alpha[-1] - 1)

    constant = None if alpha.requires_grad else shared_balance()  # a gradient needs a graph for each frame

    def edit(frame: Tensor) -> Tensor:
        check_image(frame, "frames")
        source = InMemory(frame.to(working_dtype(frame)))
        brighter = shared_balance() if alpha.requires_grad else constant
        return source.all(fit_change(source, change, planes, viewing_size, limits, brighter=brighter)).to(frame.dtype)

    return map(edit, frames)
