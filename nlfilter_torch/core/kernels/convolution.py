"""Convolutions with 3x3 weights of features that first pass through a leaky rectifier."""

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.kernels.library import kernel, pointer, run, threads
from nlfilter_torch.core.torch_internals import register

SLOPE = 0.1  # of negative features; not 0, so that units do not die
LANES = 16  # channels of the kernel in C are a multiple of this, the largest register size
# Six values from three weights: the matrix G of the paper that convolution.h names.
VALUES = torch.tensor(
    [
        [1 / 4, 0, 0],
        [-1 / 6, -1 / 6, -1 / 6],
        [-1 / 6, 1 / 6, -1 / 6],
        [1 / 24, 1 / 12, 1 / 6],
        [1 / 24, -1 / 12, 1 / 6],
        [0, 0, 1],
    ],
    dtype=torch.float32,
    device="cpu",
)


def _compiled_convolve(
    features: Tensor, weight: Tensor, bias: Tensor | None = None, dilation: int = 1, added: Tensor | None = None
) -> Tensor | None:
    outputs, (batch, channels, height, width) = len(weight), features.shape
    if channels % LANES or weight.shape[1:] != (channels, 3, 3):
        return None
    if bias is not None and bias.shape != (outputs,):
        return None
    if added is not None and added.shape != (batch, outputs, height, width):
        return None
    missing = (0, -outputs % LANES)
    with torch.autocast("cpu", enabled=False):
        weights = torch.kron(VALUES, VALUES) @ F.pad(weight.permute(2, 3, 1, 0), missing).reshape(9, -1)  # (36, C O)
    padded = weights.new_zeros(weights.shape[1] // channels) if bias is None else F.pad(bias, missing).contiguous()
    features = features.permute(0, 2, 3, 1).contiguous()
    added = None if added is None else added.permute(0, 2, 3, 1).contiguous()
    out = features.new_empty(*features.shape[:3], outputs)
    run(
        "convolution",
        threads(features),
        len(features),
        height,
        width,
        channels,
        outputs,
        len(padded),
        dilation,
        SLOPE,
        *map(pointer, (features, weights, padded, added, out)),
    )
    return out.permute(0, 3, 1, 2)


def _fake_convolve(features: Tensor, weight: Tensor, *_: object) -> Tensor:
    batch, _channels, *size = features.shape
    return features.new_empty(batch, *size, len(weight)).permute(0, 3, 1, 2)


@register(
    "convolve(Tensor features, Tensor weight, Tensor? bias=None, int dilation=1, Tensor? added=None) -> Tensor",
    kernel(_compiled_convolve),
    _fake_convolve,
    differentiable=True,
)
def convolve(
    features: Tensor, weight: Tensor, bias: Tensor | None = None, dilation: int = 1, added: Tensor | None = None
) -> Tensor:
    """Convolve rectified features (B, C, H, W), with zeros around them, and add (B, O, H, W); channels lie last."""
    convolved = F.conv2d(F.leaky_relu(features, SLOPE), weight, bias, padding=dilation, dilation=dilation)
    return channels_last(convolved if added is None else convolved + added)


def channels_last(planes: Tensor) -> Tensor:
    """Planes (B, C, H, W) with their channels last in memory; unlike ``Tensor.contiguous``, it works under ``vmap``."""
    return planes.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
