"""Of which points landmarks are made: what is held when the same landmarks are computed from other features."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Assignment:
    """Which points the landmarks of an operator are made of, without their features.

    With an assignment that is held, landmarks are a smooth function of the features, and so are W and all that is
    computed from it. Choosing landmarks anew is not: k-means starts from other points after the smallest change.

    Attributes:
        candidates: (B, S), numbers of the points from which landmarks are computed, counted over the whole image. Here
            and below, a batch size of 1 serves for all images.
        clusters: (B, S), number of the landmark that each candidate belongs to, which is the mean of its candidates;
            None if the candidates themselves are the landmarks.
        start: (B, 1, M), the candidate that replaces the mean of an empty cluster, or None.
        points: N, number of points of the whole image.
    """

    candidates: Tensor
    clusters: Tensor | None
    start: Tensor | None
    points: int

    @property
    def num_landmarks(self) -> int:
        """M."""
        return self.candidates.shape[-1] if self.start is None else self.start.shape[2]

    @property
    def batch(self) -> int:
        """Number of images that have an assignment of their own, or 1 if all share one."""
        own = self.candidates if self.clusters is None else self.clusters
        return own.shape[0]

    @property
    def kind(self) -> tuple[int, int, int, bool]:
        """What assignments have in common that can be joined to one of several images."""
        return self.points, self.candidates.shape[1], self.num_landmarks, self.clusters is None

    def serves(self, batch: int, points: int) -> bool:
        """Whether landmarks can be computed from the features of ``batch`` images of so many points."""
        return points == self.points and self.batch in (1, batch)

    def on(self, device: torch.device) -> "Assignment":
        """The assignment on a device."""
        if self.candidates.device == device:
            return self
        clusters, start = (None if tensor is None else tensor.to(device) for tensor in (self.clusters, self.start))
        return Assignment(self.candidates.to(device), clusters, start, self.points)


@dataclass(frozen=True)
class Layout:
    """Which features of a pixel belong to which place of its patch.

    Attributes:
        patch: width p of a patch; the features are C patches, row by row.
        coordinates: whether row and column of the pixel follow.
    """

    patch: int
    coordinates: bool
