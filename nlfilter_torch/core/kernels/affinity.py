"""Affinities of blocks of features to landmarks, the definition of what the kernels in C compute."""

import math

import torch
from torch import Tensor

from nlfilter_torch.core.values import is_hidden

# Beside a completed diagonal exp(-40) is nothing; smaller affinities become denormal floats, six times slower, and
# their squares vanish in float32, which would leave pixels that resemble no landmark without a single eigenvector.
SMALLEST_EXPONENT = -40.0


PLAIN_EXPONENT = -60.0  # without completion small affinities are all that links such pixels, and balancing raises them


LOG2_E = math.log2(math.e)


CANCELLATION = 1e-2  # error of a squared distance in float32 from which distances are formed in float64


def cancels(landmarks: Tensor) -> bool:
    """Whether ``|x|^2 + |z|^2 - 2 x z`` loses distances to the landmarks (B, D, M) in float32, as at tiny bandwidths.

    False on accelerators, which would have to wait for the answer.
    """
    if landmarks.dtype != torch.float32 or is_hidden(landmarks):
        return False
    largest = (landmarks - landmarks.mean(dim=2, keepdim=True)).square().sum(1).max()
    return not float(largest) * torch.finfo(torch.float32).eps < CANCELLATION


class Affinity:
    """Affinities of blocks of features to the landmarks, written into one buffer after the other.

    A fresh tensor for every block would cost more in page faults than the exponential does.

    Attributes:
        exact: distances are formed in float64; see :func:`cancels`.
    """

    def __init__(self, landmarks: Tensor, complete: bool) -> None:
        # Powers of two: exp2 takes two thirds of the time of exp, which MKL computes.
        self.floor = LOG2_E * (SMALLEST_EXPONENT if complete else PLAIN_EXPONENT)
        self.centre = landmarks.mean(dim=2, keepdim=True)  # distances are formed near the origin, where they are exact
        self.landmarks = landmarks - self.centre  # (B, D, M)
        self.exact = cancels(landmarks)
        points = self.landmarks.double() if self.exact else self.landmarks
        # -|x - z|^2 is one product, (2 z, -|z|^2, -1) with (x, 1, |x|^2).
        norms = points.square().sum(1, keepdim=True)
        rows = torch.cat([2.0 * points, -norms, -torch.ones_like(norms)], dim=1)
        self.rows = LOG2_E * rows.mT  # (B, M, D + 2)
        self.columns = points.new_empty(0, 0, 0)

    def __call__(self, features: Tensor, out: Tensor) -> tuple[Tensor, Tensor]:
        """The affinities (B, M, n) of features (B, D, n), in ``out``, and the features relative to the centre.

        Both are overwritten by the next call.
        """
        batch, size, count = features.shape
        if self.columns.shape[2] != count:
            self.columns = self.rows.new_ones(batch, size + 2, count)
        centred = torch.sub(features, self.centre, out=self.columns[:, :size])
        torch.sum(centred.square(), 1, out=self.columns[:, size + 1])
        if self.exact:
            exponents = torch.bmm(self.rows, self.columns).clamp_(self.floor, 0.0)
            return out.copy_(exponents).exp2_(), centred.to(features)
        return torch.bmm(self.rows, self.columns, out=out).clamp_(self.floor, 0.0).exp2_(), centred
