"""The functions of this package as ``torch.nn`` layers: parameters here, mathematics there."""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from nlfilter_torch.checks import check_image, check_same_size
from nlfilter_torch.features import GuideChannels
from nlfilter_torch.filtering import polynomial_filter, weigh_layers
from nlfilter_torch.landmarks import Sampling
from nlfilter_torch.masks import diffusion_mask, segment_mask
from nlfilter_torch.nystrom import Completion
from nlfilter_torch.operator import NonlocalOperator, nonlocal_operator
from nlfilter_torch.spectrum import Spectrum


class NonlocalAffinity(nn.Module):
    """Guide to operator, a layer around :func:`nonlocal_operator`, whose options it takes."""

    def __init__(
        self,
        *,
        patch_size: int = 5,
        photometric_bandwidth: float | Literal["auto"] = "auto",
        spatial_bandwidth: float | None = None,
        num_landmarks: int = 100,
        landmarks: Sampling = "kmeans",
        completion: Completion = "diagonal",
        guide_channels: GuideChannels = "luminance",
        tolerance: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.photometric_bandwidth = photometric_bandwidth
        self.spatial_bandwidth = spatial_bandwidth
        self.num_landmarks = num_landmarks
        self.landmarks: Sampling = landmarks
        self.completion: Completion = completion
        self.guide_channels: GuideChannels = guide_channels
        self.tolerance = tolerance
        self.generator = generator

    def forward(self, guide: Tensor) -> NonlocalOperator:
        """Operator of a guide (B, C, H, W)."""
        return nonlocal_operator(
            guide,
            patch_size=self.patch_size,
            photometric_bandwidth=self.photometric_bandwidth,
            spatial_bandwidth=self.spatial_bandwidth,
            num_landmarks=self.num_landmarks,
            landmarks=self.landmarks,
            completion=self.completion,
            guide_channels=self.guide_channels,
            tolerance=self.tolerance,
            generator=self.generator,
        )

    def extra_repr(self) -> str:
        """The options that decide what the operator does."""
        return (
            f"patch_size={self.patch_size}, photometric_bandwidth={self.photometric_bandwidth}, "
            f"spatial_bandwidth={self.spatial_bandwidth}, num_landmarks={self.num_landmarks}, "
            f"landmarks={self.landmarks!r}, completion={self.completion!r}, guide_channels={self.guide_channels!r}"
        )


class PolynomialSliders(nn.Module):
    """The sliders alpha as a parameter: operator and image to filtered image, a layer around :func:`polynomial_filter`.

    Attributes:
        alpha: (k+1,) parameter, fine to coarse. Paper: eq. (12).
        residual: weight of what the eigenvectors do not explain; None is alpha_1.
    """

    def __init__(self, alpha: Sequence[float] = (1.0, 1.0, 1.0, 1.0), *, residual: float | None = None) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.tensor([float(a) for a in alpha]))
        self.residual = residual

    def forward(self, operator: NonlocalOperator, image: Tensor) -> Tensor:
        """Filtered image (B, C, H, W) in the image's dtype."""
        return polynomial_filter(operator, image, self.alpha, residual=self.residual)

    def combine(self, layers: Tensor) -> Tensor:
        """The same, with ``residual`` alpha_1, from layers (B, k+1, C, H, W) of :func:`detail_layers` that are held."""
        return weigh_layers(layers, self.alpha)

    def extra_repr(self) -> str:
        """The sliders as they are now."""
        return f"alpha={[round(a, 4) for a in self.alpha.tolist()]}, residual={self.residual}"


class NonlocalFilter(nn.Module):
    """Image to edited image: :class:`NonlocalAffinity` and :class:`PolynomialSliders` in one layer.

    Paper: eq. (12), (13). The operator is built anew for every call, from the guide as it is; to move sliders over one
        image,
    hold its operator or its layers and call the parts.

    Args:
        alpha: start of the sliders, fine to coarse; ones leave the image as it is.
        residual: weight of what the eigenvectors do not explain; None is alpha_1.
        **options: of :func:`nonlocal_operator`.

    Example:
        >>> layer = NonlocalFilter(alpha=(3, 3, 4, 1.05), photometric_bandwidth=0.1, num_landmarks=30)
        >>> layer(torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))).shape
        torch.Size([2, 3, 32, 32])
        >>> list(layer.state_dict())
        ['sliders.alpha']
    """

    def __init__(
        self, alpha: Sequence[float] = (1.0, 1.0, 1.0, 1.0), *, residual: float | None = None, **options: Any
    ) -> None:
        super().__init__()
        self.affinity = NonlocalAffinity(**options)
        self.sliders = PolynomialSliders(alpha, residual=residual)

    def forward(self, image: Tensor, guide: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Filter an image.

        Args:
            image: (B, C, H, W).
            guide: (B, C', H, W) from which the operator is built; None is the image itself.
            mask: (B, 1, H, W) in [0, 1]: one where the filter acts, zero where the image stays; None is one everywhere.

        Returns:
            (B, C, H, W) in the image's dtype.
        """
        filtered: Tensor = self.sliders(self.affinity(image if guide is None else guide), image)
        if mask is None:
            return filtered
        check_image(mask, "mask", batch=image.shape[0])
        check_same_size(mask, (image.shape[-2], image.shape[-1]), "mask", "image")
        return torch.lerp(image, filtered, mask.to(image))


class DiffusionMask(nn.Module):
    """Spectrum and region to mask, a layer around :func:`diffusion_mask`.

    Args:
        time: diffusion time t > 0.
        width: diffusion distance at which the mask has fallen to 1/e.
    """

    def __init__(self, *, time: float = 1.0, width: float = 4.0) -> None:
        super().__init__()
        self.time = time
        self.width = width

    def forward(self, spectrum: Spectrum, region: Tensor) -> Tensor:
        """Mask (B, K, H, W) in (0, 1] of regions (B, K, H, W)."""
        return diffusion_mask(spectrum, region, time=self.time, width=self.width)

    def extra_repr(self) -> str:
        """Time and width."""
        return f"time={self.time}, width={self.width}"


class SegmentMask(nn.Module):
    """Spectrum and regions to a partition, a layer around :func:`segment_mask`."""

    def __init__(self, *, time: float = 1.0) -> None:
        super().__init__()
        self.time = time

    def forward(self, spectrum: Spectrum, regions: Tensor) -> Tensor:
        """Partition (B, K, H, W) of zeros and ones from regions (B, K, H, W)."""
        return segment_mask(spectrum, regions, time=self.time)

    def extra_repr(self) -> str:
        """Time."""
        return f"time={self.time}"
