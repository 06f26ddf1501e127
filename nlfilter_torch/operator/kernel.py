"""Features of guides, and columns of the factor for pixels that the operator was not built from.

A pixel's column of the factor is a function of its own patch and of the landmarks; its scaling follows from the column
and one vector of length M. Tiles of a large image, rows on another machine and other frames of a film therefore get
exact columns, without seams or flicker, if they share landmarks and moments.
"""

from dataclasses import dataclass

from torch import Tensor

from nlfilter_torch.operator.features import GuideChannels, extract_features, reduce_channels
from nlfilter_torch.operator.nystrom import Completion, nystrom_factor


@dataclass(frozen=True, eq=False)
class GuideFeatures:
    """The function that computes features of guides. Paper: eq. (1), (18).

    Attributes:
        patch_weights: (p, p), of unit sum.
        photometric_bandwidth: h_y, () or (B,) or a number.
        spatial_bandwidth: h_x in pixels, () or (B,) or a number, or None.
        guide_channels: ``"luminance"`` or ``"all"``.
    """

    patch_weights: Tensor
    photometric_bandwidth: float | Tensor
    spatial_bandwidth: float | Tensor | None
    guide_channels: GuideChannels

    def __call__(
        self, guide: Tensor, *, origin: tuple[int, int] = (0, 0), halo: tuple[int, int] = (0, 0), stride: int = 1
    ) -> Tensor:
        """Compute features (B, D, N) of any guide (B, C, H, W), or of a tile; see :func:`extract_features`.

        The guide must have the channels of the original guide, from which the landmarks come, and ``origin`` is in
        coordinates of the original guide. A halo is half a patch, or less at the border of the whole guide.
        """
        return extract_features(
            reduce_channels(guide.to(self.patch_weights.dtype), self.guide_channels),
            patch_weights=self.patch_weights,
            photometric_bandwidth=self.photometric_bandwidth,
            spatial_bandwidth=self.spatial_bandwidth,
            origin=origin,
            halo=halo,
            stride=stride,
        )


@dataclass(frozen=True, eq=False)
class Kernel:
    """Affinities to a fixed set of landmarks.

    Attributes:
        landmarks: (B, D, M).
        inverse_cholesky: (B, M, M).
        completion: ``"diagonal"`` or ``"none"``.
        limiter: (B, M, M) matrix by which the factor is multiplied so that no eigenvalue of W exceeds 1, or None.
        features: computes features of a guide; None if the operator was made from features.
    """

    landmarks: Tensor
    inverse_cholesky: Tensor
    completion: Completion
    limiter: Tensor | None = None
    features: GuideFeatures | None = None

    @property
    def recipe(self) -> GuideFeatures:
        """The function that computes features of a guide.

        Raises:
            ValueError: if the operator was made from features.
        """
        if self.features is None:
            raise ValueError(
                "operator must be built by nonlocal_operator to be applied to other guides, got one from features; "
                "use operator.at(features)"
            )
        return self.features

    def columns(
        self, guide: Tensor, *, origin: tuple[int, int] = (0, 0), halo: tuple[int, int] = (0, 0)
    ) -> tuple[Tensor, Tensor]:
        """Compute factor (B, M, N) and diagonal (B, N) of the pixels of any guide; see :class:`GuideFeatures`."""
        return self.factor(self.recipe(guide, origin=origin, halo=halo))

    def factor(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Compute factor (B, M, n) and diagonal (B, n) of pixels with features (B, D, n).

        Landmarks with a batch size of 1 serve for all images.
        """
        shape = (features.shape[0], -1, -1)
        landmarks, inverse = self.landmarks.expand(shape), self.inverse_cholesky.expand(shape)
        factor, diagonal = nystrom_factor(features, landmarks, inverse, self.completion)
        return factor if self.limiter is None else self.limiter @ factor, diagonal
