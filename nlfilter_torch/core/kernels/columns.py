"""Columns of the Nystrom factor, from the affinities of features to landmarks, and their gradients."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import buffered_blocks, strip_count, strips
from nlfilter_torch.core.kernels.library import (
    ONE_THREAD_COLUMNS,
    by_rows,
    contiguous,
    kernel,
    place,
    pointer,
    run,
    threads,
)
from nlfilter_torch.core.torch_internals import is_hidden, register

# Compared with a completed diagonal exp(-40) is negligible. Smaller affinities would become denormal floats, which are
# six times slower, and their squares would underflow in float32, so that pixels unlike all landmarks would be zero in
# all eigenvectors.
SMALLEST_EXPONENT = -40.0
# Without completion, pixels unlike all landmarks are linked by small affinities only, which balancing amplifies.
PLAIN_EXPONENT = -60.0
LOG2_E = math.log2(math.e)
CANCELLATION = 1e-2  # float32 error of a squared distance above which distances are computed in float64
LINE = 16  # numbers: one cache line in float32, two in float64


def large_empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Uninitialised tensor in the dtype and on the device of ``like``, in memory whose first write is fast.

    On Linux, numpy requests huge pages and torch does not: the first write of 400 MB takes 50 ms instead of 200. The
    tensor is aligned to a cache line, so that whole lines can be written without being read first.
    """
    if is_hidden(like) or like.dtype not in (torch.float32, torch.float64):
        return like.new_empty(shape)
    numbers = np.empty(math.prod(shape) + LINE, np.float64 if like.dtype == torch.float64 else np.float32)
    start = -(numbers.ctypes.data // numbers.itemsize) % LINE
    return torch.from_numpy(numbers[start : start + math.prod(shape)].reshape(shape))


def cancels(landmarks: Tensor) -> bool:
    """Whether ``|x|^2 + |z|^2 - 2 x z`` cancels in float32 for the landmarks (B, D, M), as at tiny bandwidths.

    False on accelerators, where finding out would stall the queue.
    """
    if landmarks.dtype != torch.float32 or is_hidden(landmarks):
        return False
    landmarks = landmarks.detach()
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


def _empty(features: Tensor, landmarks: Tensor) -> tuple[Tensor, Tensor]:
    """An uninitialised factor, and squared norms initialised to 1."""
    batch, _, pixels = features.shape
    return large_empty((batch, landmarks.shape[2], pixels), features), features.new_ones(batch, pixels)


def _fake_columns(features: Tensor, landmarks: Tensor, *others: object) -> tuple[Tensor, Tensor]:
    batch, _, pixels = features.shape
    return features.new_empty(batch, landmarks.shape[2], pixels), features.new_empty(batch, pixels)


def _compiled_columns(
    features: Tensor, landmarks: Tensor, inverse_cholesky: Tensor, limited: bool
) -> tuple[Tensor, Tensor] | None:
    affinity = Affinity(landmarks, limited)
    if affinity.exact:
        return None
    factor, norms = _empty(features, landmarks)
    features = by_rows(features)
    centre, rows, inverse_cholesky = contiguous(affinity.centre, affinity.rows, inverse_cholesky)
    batch, size, pixels = features.shape
    run(
        "columns", threads(factor, ONE_THREAD_COLUMNS), pixels, batch, size, factor.shape[1], *place(features),
        centre.data_ptr(), rows.data_ptr(), inverse_cholesky.data_ptr(), affinity.floor, limited, *place(factor),
        norms.data_ptr(),
    )  # fmt: skip
    return factor, norms


@register(
    "columns(Tensor features, Tensor landmarks, Tensor inverse_cholesky, bool limited) -> (Tensor, Tensor)",
    kernel(_compiled_columns),
    _fake_columns,
)
def columns(features: Tensor, landmarks: Tensor, inverse_cholesky: Tensor, limited: bool) -> tuple[Tensor, Tensor]:
    """Compute columns (B, M, N) of the Nystrom factor, and their squared norms (B, N) before limiting.

    Takes features (B, D, N), landmarks (B, D, M) and the inverse Cholesky factor (B, M, M) of the landmark block. If
    ``limited``, columns are scaled to norm at most 1; otherwise the returned norms are ones.
    """
    factor, norms = _empty(features, landmarks)
    batch, pixels = norms.shape
    count = strip_count(batch, pixels, features.device)
    affinity = Affinity(_repeat(landmarks, count), limited)
    inverses = _repeat(inverse_cholesky, count)
    parts, columns_of, norms_of = strips(features, count), strips(factor, count), norms.view(count * batch, -1)
    for block, (first, second) in buffered_blocks(columns_of, 2):
        kernel, _ = affinity(parts[:, :, block], first)
        product = torch.bmm(inverses, kernel, out=second)  # into a buffer, since rows of the factor are far apart
        if limited:
            norm = torch.sum(torch.square(product, out=first), 1, out=norms_of[:, block])
            # Norms exceed 1 only by rounding, and most blocks need no scaling. Accelerators scale without checking.
            if is_hidden(features) or norm.max().item() > 1.0:
                product.mul_(norm.clamp(min=1.0).rsqrt_().unsqueeze(1))
        columns_of[:, :, block] = product
    return factor, norms


def _fake_backward(*arguments: Tensor) -> tuple[Tensor, ...]:
    return tuple(tensor.new_empty(tensor.shape) for tensor in arguments[:3])


def _compiled_backward(
    features: Tensor,
    landmarks: Tensor,
    inverse_cholesky: Tensor,
    limited: bool,
    factor: Tensor,
    scale: Tensor,
    gradient: Sequence[Tensor],
    diagonal: Tensor,
) -> tuple[Tensor, Tensor, Tensor] | None:
    affinity = Affinity(landmarks, limited)
    if affinity.exact:
        return None
    # Times the gradients with respect to the exponents, these give those with respect to the features.
    points = 2.0 * torch.cat([affinity.landmarks, torch.ones_like(landmarks[:, :1])], dim=1)  # (B, D + 1, M)
    grad_features = large_empty(features.shape, features)
    features, factor, right = map(by_rows, (features, factor, gradient[-1]))
    left = gradient[0].contiguous() if len(gradient) == 2 else None
    centre, rows, inverse_cholesky, points = contiguous(affinity.centre, affinity.rows, inverse_cholesky, points)
    scale, diagonal = contiguous(scale, diagonal)
    (batch, size, pixels), count = features.shape, factor.shape[1]
    sums = torch.empty(batch, count * (count + size + 1), dtype=torch.float64)
    run(
        "backward", threads(factor, ONE_THREAD_COLUMNS), pixels, batch, size, count, *place(features),
        centre.data_ptr(), rows.data_ptr(),
        inverse_cholesky.data_ptr(), affinity.floor, limited, *place(factor), scale.data_ptr(), right.shape[1],
        pointer(left), *place(right), diagonal.data_ptr(), points.data_ptr(), grad_features.data_ptr(),
        sums.data_ptr(),
    )  # fmt: skip
    grad_inverse, products = sums.split([count * count, count * (size + 1)], dim=1)
    products = products.unflatten(1, (count, size + 1))  # of the gradients of the exponents with (features, 1)
    grad_landmarks = 2.0 * (products[:, :, :-1].mT - affinity.landmarks * products[:, None, :, -1])
    by_landmarks, by_inverse = contiguous(grad_landmarks.float(), grad_inverse.unflatten(1, (count, count)).float())
    return grad_features, by_landmarks, by_inverse


@register(
    "columns_backward(Tensor features, Tensor landmarks, Tensor inverse_cholesky, bool limited, Tensor factor, "
    "Tensor scale, Tensor[] gradient, Tensor diagonal) -> (Tensor, Tensor, Tensor)",
    kernel(_compiled_backward),
    _fake_backward,
)
def columns_backward(
    features: Tensor,
    landmarks: Tensor,
    inverse_cholesky: Tensor,
    limited: bool,
    factor: Tensor,
    scale: Tensor,
    gradient: Sequence[Tensor],
    diagonal: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`columns` with respect to features, landmarks and the inverse Cholesky factor.

    Besides the arguments of :func:`columns`, it takes the columns (B, M, N), the ``scale`` (B, N) by which they were
    limited, and gradients of the loss: ``gradient`` with respect to the columns, (B, M, N) or the pair (B, M, r) and
    (B, r, N) whose product it is, and ``diagonal`` (B, N) with respect to 1 - |u|^2 where that is not negative. For a
    triangular inverse Cholesky factor, its gradient above the diagonal may be omitted.
    """
    grad_features = large_empty(features.shape, features)
    batch, pixels = scale.shape
    count = strip_count(batch, pixels, features.device)
    landmarks, inverse_cholesky = _repeat(landmarks, count), _repeat(inverse_cholesky, count)
    features, factor = strips(features, count), strips(factor, count)
    scale, diagonal = (vector.reshape(count * batch, -1) for vector in (scale, diagonal))
    left = _repeat(gradient[0], count) if len(gradient) == 2 else None
    right, grad_parts = strips(gradient[-1], count), strips(grad_features, count)
    affinity = Affinity(landmarks, limited)
    grad_landmarks = torch.zeros_like(landmarks, dtype=torch.float64)
    grad_inverse = torch.zeros_like(inverse_cholesky, dtype=torch.float64)
    for block, (first, second, third) in buffered_blocks(factor, 3):
        kernel, centred = affinity(features[:, :, block], first)
        part = right[:, :, block]
        grad = second.copy_(part) if left is None else torch.bmm(left, part, out=second)
        if limited:
            # Columns scaled to u / |u| have no gradient along themselves; the others add the gradient of 1 - |u|^2.
            shrink = scale[:, None, block]
            along = torch.mul(factor[:, :, block], grad, out=third).sum(1, keepdim=True)
            along = torch.where(shrink < 1.0, along, 2.0 * diagonal[:, None, block])
            grad.sub_(torch.mul(factor[:, :, block], along, out=third)).mul_(shrink)
        grad_inverse += grad @ kernel.mT
        # K_im = exp(-|x_i - z_m|^2) has the derivative -2 (x_i - z_m) K_im in x_i, and its negative in z_m.
        pull = torch.bmm(inverse_cholesky.mT, grad, out=third).mul_(kernel)  # (B, M, n)
        grad_parts[:, :, block] = 2.0 * (affinity.landmarks @ pull - centred * pull.sum(1, keepdim=True))
        grad_landmarks += 2.0 * (centred @ pull.mT - affinity.landmarks * pull.sum(2).unsqueeze(1))
    if count > 1:
        grad_landmarks, grad_inverse = grad_landmarks.sum(0, keepdim=True), grad_inverse.sum(0, keepdim=True)
    by_landmarks, by_inverse = contiguous(grad_landmarks.to(features.dtype), grad_inverse.to(features.dtype))
    return grad_features, by_landmarks, by_inverse


def _repeat(matrices: Tensor, count: int) -> Tensor:
    """Repeat matrices (1, ., .) for each of ``count`` strips of an image; for a batch (B, ., .), ``count`` is 1."""
    return matrices.repeat(count, 1, 1)
