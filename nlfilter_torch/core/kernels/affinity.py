"""Affinities of blocks of features to landmarks: the definition in torch of what the kernels in C compute."""

import math

import torch
from torch import Tensor

from nlfilter_torch.core.values import is_hidden

# Compared with a completed diagonal exp(-40) is negligible. Smaller affinities would become denormal floats, which are
# six times slower, and their squares would underflow in float32, so that pixels unlike all landmarks would be zero in
# all eigenvectors.
SMALLEST_EXPONENT = -40.0


# Without completion, pixels unlike all landmarks are linked by small affinities only, which balancing amplifies.
PLAIN_EXPONENT = -60.0


LOG2_E = math.log2(math.e)


CANCELLATION = 1e-2  # float32 error of a squared distance above which distances are computed in float64


def cancels(landmarks: Tensor) -> bool:
    """Whether ``|x|^2 + |z|^2 - 2 x z`` cancels in float32 for the landmarks (B, D, M), as at tiny bandwidths.

    False on accelerators, where finding out would stall the queue.
    """
    if landmarks.dtype != torch.float32 or is_hidden(landmarks):
        return False
    largest = (landmarks - landmarks.mean(dim=2, keepdim=True)).square().sum(1).max()
    return not float(largest) * torch.finfo(torch.float32).eps < CANCELLATION


class Affinity:
    """Affinities of blocks of features to the landmarks, written into a given buffer.

    A new tensor for every block would cost more time in page faults than the exponential.

    Attributes:
        exact: whether distances are computed in float64; see :func:`cancels`.
    """

    def __init__(self, landmarks: Tensor, complete: bool) -> None:
        # Powers of two: exp2 takes two thirds of the time of MKL's exp.
        self.floor = LOG2_E * (SMALLEST_EXPONENT if complete else PLAIN_EXPONENT)
        self.centre = landmarks.mean(dim=2, keepdim=True)  # centred features give more accurate distances
        self.landmarks = landmarks - self.centre  # (B, D, M)
        self.exact = cancels(landmarks)
        points = self.landmarks.double() if self.exact else self.landmarks
        # -|x - z|^2 is one product: (2 z, -|z|^2, -1) times (x, 1, |x|^2).
        norms = points.square().sum(1, keepdim=True)
        rows = torch.cat([2.0 * points, -norms, -torch.ones_like(norms)], dim=1)
        self.rows = LOG2_E * rows.mT  # (B, M, D + 2)
        self.columns = points.new_empty(0, 0, 0)

    def __call__(self, features: Tensor, out: Tensor) -> tuple[Tensor, Tensor]:
        """Write affinities (B, M, n) of features (B, D, n) to ``out``; return them and the centred features.

        The next call overwrites both.
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
