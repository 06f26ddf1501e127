"""The recipe of a fitted operator: all that it takes to compute the rows of its factor for pixels it has not seen.

A pixel's column of the factor is a function of its own patch and of the landmarks; its scaling is a closed form of
that column and of one m-vector. Tiles of an image that fits no memory, rows on another machine and the other frames of
a film are therefore exact, without seams and without flicker, as long as landmarks and moments are shared.
"""

from dataclasses import dataclass

from torch import Tensor

from nlfilter_torch.operator.features import GuideChannels, extract_features, reduce_channels
from nlfilter_torch.operator.nystrom import Completion, nystrom_factor


@dataclass(frozen=True, eq=False)
class Kernel:
    """Affinities to a fixed set of landmarks. Paper: eq. (1), (5), (18).

    Attributes:
        patch_weights: (p, p), of unit sum.
        photometric_bandwidth: h_y, () or (B,) or a number.
        spatial_bandwidth: h_x in pixels, likewise, or None.
        guide_channels: ``"luminance"`` or ``"all"``.
        landmarks: (B, D, M).
        whitening: (B, M, M).
        completion: ``"diagonal"`` or ``"none"``.
        limiter: (B, M, M) that the factor is multiplied by so that no eigenvalue of W exceeds 1, or None.
    """

    patch_weights: Tensor
    photometric_bandwidth: float | Tensor
    spatial_bandwidth: float | Tensor | None
    guide_channels: GuideChannels
    landmarks: Tensor
    whitening: Tensor
    completion: Completion
    limiter: Tensor | None = None

    def columns(
        self, guide: Tensor, *, origin: tuple[int, int] = (0, 0), halo: tuple[int, int] = (0, 0)
    ) -> tuple[Tensor, Tensor]:
        """Factor (B, M, N) and diagonal (B, N) of the pixels of any guide (B, C, H, W).

        Args:
            guide: with the channels of the guide that the landmarks come from.
            origin: row and column of its first pixel in the coordinates of that guide, for tiles.
            halo: rows at the top and at the bottom of a tile that only patches reach into; they get no columns. Half a
                patch, or as many as there are before the border of the whole guide.
        """
        return self.factor(self.features(guide, origin=origin, halo=halo))

    def factor(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Factor (B, M, n) and diagonal (B, n) of pixels with features (B, D, n)."""
        factor, diagonal = nystrom_factor(features, self.landmarks, self.whitening, self.completion)
        return factor if self.limiter is None else self.limiter @ factor, diagonal

    def features(self, guide: Tensor, *, origin: tuple[int, int], halo: tuple[int, int]) -> Tensor:
        """Features (B, D, N) of the same pixels."""
        return extract_features(
            reduce_channels(guide.to(self.landmarks.dtype), self.guide_channels),
            patch_weights=self.patch_weights,
            photometric_bandwidth=self.photometric_bandwidth,
            spatial_bandwidth=self.spatial_bandwidth,
            origin=origin,
            halo=halo,
        )
