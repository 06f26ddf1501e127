"""Contrast and local contrast around the mean by the last two sliders. Paper: Figs. 6(a), 7(b) to 10(b)."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_order
from nlfilter_torch.operator.options import Completion, GuideChannels, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import TONE
from nlfilter_torch.photo.picture.changes import DetailChange
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.measuring import mean
from nlfilter_torch.photo.picture.pixels import LessMean, M
from nlfilter_torch.photo.picture.source import Fitted, Guide, Source, luminance
from nlfilter_torch.photo.picture.viewing import fit_change


def adjust_tone(
    image: Tensor,
    *,
    contrast: float | Tensor = TONE["contrast"].idle_number,
    clarity: float | Tensor = TONE["clarity"].idle_number,
    order: int = 3,
    limits: Limits = TONE.defaults["limits"],
    viewing_size: float = TONE.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = TONE.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | str | None = TONE.defaults["spatial_bandwidth"],
    patch_size: int = TONE.defaults["patch_size"],
    num_landmarks: int = TONE.defaults["num_landmarks"],
    landmarks: Sampling = TONE.defaults["landmarks"],
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "luminance",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Change the contrast of large shapes, and of the coarsest detail on them, without changing the mean.

    Paper: eq. (12) with alpha_{k+1} = contrast and alpha_k = clarity, applied to the image less its mean: since W
    preserves constants, the paper's own form would multiply the mean by alpha_{k+1}.

    Args:
        image: (B, C, H, W); with C = 3 it is RGB, and its colours are kept.
        contrast: alpha_{k+1}, a number or a tensor of shape () or (B,); 1 changes nothing, 1.4 is strong.
        clarity: alpha_k, a number or a tensor of shape () or (B,); larger values than for ``contrast`` are usable.
        order: k, at least 1.
        limits: ``"soft"`` keeps detail in highlights and shadows, ``"none"`` adds the change as it is, lets them clip,
            and preserves the mean exactly.
        viewing_size: in megapixels; larger images are edited like their reduction to this size, with patches and
            bandwidths in its pixels; 0 is the size of the image.
        photometric_bandwidth: h_y, or ``"auto"``.
        spatial_bandwidth: h_x in pixels; None is a twelfth of the short side, ``"none"`` compares pixels regardless of
            their distance.
        patch_size: width of the compared patches of the filter.
        num_landmarks: M.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        guide_channels: what the filter compares, ``"luminance"`` or ``"all"`` channels.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, C, H, W) with nearly the same mean brightness; with ``limits="none"``, exactly the same mean in every
        channel, and values that may leave [0, 1]. Differentiable in image, contrast
        and clarity.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> strong = adjust_tone(image, contrast=1.4, limits="none", num_landmarks=50)
        >>> bool((strong.mean((2, 3)) - image.mean((2, 3))).abs().max() < 1e-5), bool(strong.std() > image.std())
        (True, True)
    """
    return edited(Tone, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Tone(PhotoEdit):
    """The edit of :func:`adjust_tone`."""

    declared: ClassVar[Edit] = TONE
    relative: ClassVar[bool] = True
    contrast: float | Tensor
    clarity: float | Tensor
    order: int = 3
    limits: Limits
    viewing_size: float

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the change of contrast of a picture."""
        check_order(self.order)
        check_count(self.options.num_landmarks, "num_landmarks")
        TONE.check(source.batch, contrast=self.contrast, limits=self.limits, viewing_size=self.viewing_size)
        TONE.check(source.batch, clarity=self.clarity)
        return fit_change(source, self._change, luminance, self.viewing_size, self.limits)

    def guide(self, size: tuple[int, int]) -> Guide:
        """The guide of a picture (H, W) at the viewing size, and the options of the filter."""
        return Guide(self.filter_options(size, fewer_landmarks=True))

    def _change(self, viewed: Source[M]) -> Fitted:
        """The change of luminance of a picture at the viewing size."""
        operator, planes = viewed.operator(self.guide(viewed.size)), LessMean(luminance, mean(viewed, luminance))
        return Fitted(DetailChange.of(operator, planes, self._sliders(viewed.batch, viewed.dtype), None).whole)

    def _sliders(self, batch: int, dtype: torch.dtype) -> Tensor:
        """Sliders less 1, (B, k+1), with which the filter gives the change."""
        clarity, contrast = (
            torch.as_tensor(value, dtype=dtype).reshape(-1).expand(batch) - 1 for value in (self.clarity, self.contrast)
        )
        fine = [torch.zeros(batch, dtype=contrast.dtype, device=contrast.device)] * (self.order - 1)
        return torch.stack([*fine, clarity, contrast], dim=1)
