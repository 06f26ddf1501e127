"""Validation at the public boundary: one sentence, naming argument, requirement, value received and remedy.

Functions inside the package trust what they are given; only public functions call these.
"""

import math
import sys
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

FLOATING = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def check_tensor(value: object, name: str, remedy: str = "convert it with torch.tensor") -> None:
    """Raise unless ``value`` is a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}; {remedy}")


def check_image(image: Tensor, name: str, *, channels: int | None = None, batch: int | None = None) -> None:
    """Raise unless ``image`` is a finite floating-point (B, C, H, W) tensor with at least one pixel."""
    check_tensor(image, name, "convert it with torch.as_tensor")
    if image.dtype not in FLOATING:
        raise TypeError(
            f"{name} must be of a floating-point dtype with values in [0, 1], got {image.dtype}; "
            "divide integer pixels by their largest value"
        )
    if image.ndim != 4:
        raise ValueError(f"{name} must have shape (B, C, H, W), got {tuple(image.shape)}; add the missing dimensions")
    if image.numel() == 0:
        raise ValueError(f"{name} must hold at least one pixel, got shape {tuple(image.shape)}; pass a non-empty image")
    if channels is not None and image.shape[1] != channels:
        raise ValueError(
            f"{name} must have {channels} channel(s), got {image.shape[1]}; select or convert the channels"
        )
    if batch is not None and image.shape[0] not in (1, batch):
        raise ValueError(f"{name} must have batch size 1 or {batch}, got {image.shape[0]}; pass one image per guide")
    check_finite(image, name)


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise if ``tensor`` holds NaN or infinity; skipped on accelerators (no synchronisation) and while compiling."""
    if tensor.device.type != "cpu" or torch.compiler.is_compiling() or is_transformed(tensor):
        return
    values = tensor.detach()
    # Their sum tells in a tenth of the time that looking at each would take, unless finite ones overflow it.
    if bool(values.sum().isfinite()):
        return
    bad = int((~torch.isfinite(values)).sum())
    if bad > 0:
        raise ValueError(f"{name} must be finite, got {bad} NaN or infinite value(s); replace them first")


def check_unit_range(tensor: Tensor, name: str) -> None:
    """Raise unless all values are in [0, 1]; skipped where :func:`check_finite` is."""
    if tensor.device.type != "cpu" or torch.compiler.is_compiling() or is_transformed(tensor):
        return
    low, high = tensor.detach().aminmax()
    if low < 0 or high > 1:
        raise ValueError(f"{name} must be in [0, 1], got values from {low:g} to {high:g}; scale or clamp it")


def is_transformed(tensor: Tensor) -> bool:
    """True under ``torch.func`` transforms, where the values of a tensor cannot be looked at."""
    return bool(torch._C._functorch.is_functorch_wrapped_tensor(tensor))


def check_same_size(tensor: Tensor, size: tuple[int, int], name: str, other: str) -> None:
    """Raise unless the last two dimensions of ``tensor`` are ``size``."""
    if tuple(tensor.shape[-2:]) != tuple(size):
        raise ValueError(
            f"{name} must have the height and width of the {other}, {size[0]}x{size[1]}, "
            f"got {tensor.shape[-2]}x{tensor.shape[-1]}; resize one of them"
        )


def check_patch_size(patch_size: int) -> None:
    """Raise unless ``patch_size`` is an odd positive integer."""
    if isinstance(patch_size, bool) or not isinstance(patch_size, int):
        raise TypeError(f"patch_size must be an int, got {type(patch_size).__name__}; pass 1, 3, 5, ...")
    if patch_size < 1 or patch_size % 2 == 0:
        raise ValueError(f"patch_size must be odd and at least 1, got {patch_size}; try {abs(patch_size) // 2 * 2 + 1}")


def check_choice(value: str, name: str, choices: Sequence[str]) -> None:
    """Raise unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}; choose one of these")


def check_positive(value: float | Tensor, name: str) -> None:
    """Raise unless ``value`` (a number, or a tensor on the CPU) is positive and finite everywhere."""
    if isinstance(value, Tensor):
        if value.device.type != "cpu" or torch.compiler.is_compiling() or is_transformed(value):
            return
        detached = value.detach()
        if not bool(((detached > 0) & torch.isfinite(detached)).all()):
            raise ValueError(f"{name} must be positive and finite, got {detached.tolist()}; clamp or reparametrise it")
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a number or a tensor, got {type(value).__name__}; pass a positive number")
    elif not (value > 0 and math.isfinite(value)):
        raise ValueError(f"{name} must be positive and finite, got {value}; pass a positive number")


def check_reach(value: float, name: str, size: tuple[int, int]) -> None:
    """Raise unless a blur by ``value`` pixels, at least 0, stays within an image of ``size``: time and memory grow."""
    most = max(min(size) / 2, 2.0)  # a default for large images is none too large for tiny ones
    if not value <= most:
        raise ValueError(
            f"{name} must be at most half the short side of the image, {most:g} pixels, got {value:g}; lower it"
        )


def check_bandwidth(value: float | Tensor, name: str, batch: int) -> None:
    """Raise unless ``value`` is one positive bandwidth, or one for every image of the batch."""
    check_positive(value, name)
    if isinstance(value, Tensor) and value.numel() != 1 and tuple(value.shape) != (batch,):
        raise ValueError(
            f"{name} must be a number or have shape () or ({batch},), got {tuple(value.shape)}; reshape it"
        )


def check_count(value: int, name: str) -> None:
    """Raise unless ``value`` is a positive integer."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} must be an int, got {type(value).__name__}; pass a positive integer")
    if value < 1:
        raise ValueError(f"{name} must be at least 1, got {value}; pass a positive integer")


def check_shape(tensor: Tensor, shape: tuple[int, ...], name: str, remedy: str) -> None:
    """Raise unless ``tensor`` is one of that shape."""
    check_tensor(tensor, name, remedy)
    if tensor.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}; {remedy}")


def check_alpha(alpha: Tensor, *, dimensions: Sequence[int] = (1, 2, 4)) -> None:
    """Raise unless ``alpha`` holds at least two sliders: (k+1,), (B, k+1) or, where allowed, (B, k+1, H, W)."""
    check_tensor(alpha, "alpha")
    if alpha.dtype not in FLOATING:
        raise TypeError(f"alpha must be of a floating-point dtype, got {alpha.dtype}; write 1.0 instead of 1")
    if alpha.ndim not in dimensions:
        shapes = {1: "(k+1,)", 2: "(B, k+1)", 4: "(B, k+1, H, W)"}
        wanted = " or ".join(shapes[n] for n in dimensions)
        raise ValueError(f"alpha must have shape {wanted}, got {tuple(alpha.shape)}; reshape it")
    entries = alpha.shape[0] if alpha.ndim == 1 else alpha.shape[1]
    if entries < 2:
        raise ValueError(
            f"alpha must have at least two entries, got {entries}; give one per layer, such as (1, 1, 1, 1)"
        )
    check_finite(alpha, "alpha")


def warn(message: str) -> None:
    """Warn at the line that called this package, however many wrappers and modules lie between."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("nlfilter_torch", "torch"):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
