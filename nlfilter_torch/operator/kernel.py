"""Features of guides, and columns of the factor for pixels that the operator was not built from.

A pixel's column of the factor is a function of its own patch and of the landmarks; its scaling follows from the column
and one vector of length M. Tiles of a large image, rows on another machine and other frames of a film therefore get
exact columns, without seams or flicker, if they share landmarks and moments.
"""

from dataclasses import dataclass

from torch import Tensor

from nlfilter_torch.operator.features import GuideFeatures
from nlfilter_torch.operator.nystrom import Completion, nystrom_factor


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
        """Compute factor (B, M, n) and diagonal (B, n) of pixels with features (B, D, n)."""
        factor, diagonal = nystrom_factor(features, self.landmarks, self.inverse_cholesky, self.completion)
        return factor if self.limiter is None else self.limiter @ factor, diagonal
