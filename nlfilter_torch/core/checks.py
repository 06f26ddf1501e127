"""Validation of public arguments. Each error is one sentence: the argument, the requirement, the value, the remedy.

Only public functions validate; internal functions trust their arguments.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle
from numbers import Integral, Real
from typing import Any, TypeGuard

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_hidden, refuse_transforms
from nlfilter_torch.core.warning import warn

FLOATING = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
Response = Callable[[Tensor], Tensor]

LARGEST_PATCH = 101  # features take patch_size^2 times the memory of the guide
LARGEST_ORDER = 1000  # each order takes a copy of the image
LARGEST_EIGENVALUE = 1e6
SHAPES = {3: "(B, C, N)", 4: "(B, C, H, W)", 5: "(B, C, D, H, W)"}  # of images, by their number of dimensions
SHOWN = 16  # values of a tensor in a message; of a larger one, only the first wrong value
LEAST_WEIGHT = 1e-6  # of a point; the largest is its inverse, above which float32 sums lose the other points
FAR_OUTSIDE = 16.0  # above the values of HDR pictures with white at 1, below those of 8-bit pictures

#: Allowed ranges of finite numbers: description, test and remedy.
DOMAINS: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "positive": ("positive and finite", lambda v: v > 0, "pass a positive number"),
    "not negative": ("at least 0 and finite", lambda v: v >= 0, "pass 0 or more"),
    "share": ("in [0, 1]", lambda v: (v >= 0) & (v <= 1), "clamp it"),
    "up to 10": ("in [0, 10]", lambda v: (v >= 0) & (v <= 10), "clamp it"),
    "below 1": ("in [0, 1)", lambda v: (v >= 0) & (v < 1), "clamp it"),
    "signed share": ("in [-1, 1]", lambda v: (v >= -1) & (v <= 1), "clamp it"),
    "stops": ("in [-5, 5]", lambda v: (v >= -5) & (v <= 5), "clamp it"),
    "finite": ("finite", lambda v: v == v, "pass a finite number"),
}


def check_tensor(value: object, name: str, remedy: str = "convert it with torch.tensor") -> None:
    """Raise unless ``value`` is a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}; {remedy}")
    if value.layout != torch.strided:
        raise TypeError(f"{name} must be a dense tensor, got {value.layout}; call .to_dense()")


def check_dtype(tensor: Tensor, name: str, remedy: str, *, values: str = "") -> None:
    """Raise unless ``tensor`` is a tensor of a floating-point dtype; ``values`` is inserted in the message."""
    check_tensor(tensor, name)
    if tensor.dtype not in FLOATING:
        remedy = "convert it with .float()" if tensor.dtype == torch.bool else remedy
        raise TypeError(f"{name} must have a floating-point dtype{values}, got {tensor.dtype}; {remedy}")


def check_instance(value: object, kind: type, name: str, remedy: str) -> None:
    """Raise unless ``value`` is an instance of ``kind``."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {kind.__name__}, got {type(value).__name__}; {remedy}")


def check_image(
    image: Tensor,
    name: str,
    *,
    channels: int | None = None,
    batch: int | None = None,
    empty: bool = False,
    dimensions: Sequence[int] = (4,),
) -> None:
    """Raise unless ``image`` is a finite floating-point tensor with pixels, (B, C, H, W) unless stated otherwise.

    B may be 0 if ``empty``. ``dimensions`` are the numbers of dimensions that are allowed; see :data:`SHAPES`.
    """
    check_tensor(image, name, "convert it with torch.as_tensor")
    check_dtype(
        image, name, "divide integer pixels by the value of white, such as 255", values=" with values in [0, 1]"
    )
    if image.ndim not in dimensions:
        shapes = " or ".join(SHAPES.get(n, f"of {n} dimensions") for n in dimensions)
        remedy = "add the missing dimensions" if image.ndim < min(dimensions) else "index or flatten the others"
        raise ValueError(f"{name} must have shape {shapes}, got {tuple(image.shape)}; {remedy}")
    if 0 in image.shape[empty:]:
        raise ValueError(f"{name} must hold at least one pixel, got shape {tuple(image.shape)}; pass a non-empty image")
    if channels is not None and image.shape[1] != channels:
        raise ValueError(
            f"{name} must have {channels} channel(s), got {image.shape[1]}; select or convert the channels"
        )
    if batch is not None and image.shape[0] not in (1, batch):
        sizes = "1" if batch == 1 else f"1 or {batch}"
        raise ValueError(
            f"{name} must have batch size {sizes}, got {image.shape[0]}; pass one for each image, or one for all"
        )
    check_finite(image, name)


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise if ``tensor`` holds NaN or infinity; skipped if :func:`~nlfilter_torch.core.torch_internals.is_hidden`."""
    if is_hidden(tensor):
        return
    values = tensor.detach()
    # The sum takes a tenth of the time of checking each value, but overflows for large finite values.
    if math.isfinite(float(values.sum())):
        return
    if bad := int((~torch.isfinite(values)).sum()):
        raise ValueError(f"{name} must be finite, got {bad} NaN or infinite value(s); replace them first")


def check_unit_range(tensor: Tensor, name: str) -> None:
    """Raise unless all values are in [0, 1]; skipped if :func:`~nlfilter_torch.core.torch_internals.is_hidden`."""
    if is_hidden(tensor) or tensor.numel() == 0:
        return
    low, high = tensor.detach().aminmax()
    if low < 0 or high > 1:
        raise ValueError(f"{name} must be in [0, 1], got values from {low:g} to {high:g}; scale or clamp it")


def check_photograph(image: Tensor, name: str, *, channels: int | None = None, batch: int | None = None) -> None:
    """:func:`check_image`, and warn if values are far outside [0, 1]; see :func:`warn_of_scale`."""
    check_image(image, name, channels=channels, batch=batch)
    warn_of_scale(image, name)


def warn_of_scale(image: Tensor, name: str) -> bool:
    """Warn if an image of 1 or 3 channels has values above 16: probably 8-bit pixels converted to floats.

    Skipped if :func:`~nlfilter_torch.core.torch_internals.is_hidden`. Images with other numbers of channels are feature
    maps, whose values are not limited; HDR pictures stay below 16. Returns whether it warned.
    """
    if is_hidden(image) or image.shape[1] not in (1, 3) or len(image) == 0:
        return False
    largest = float(image.detach().max())
    if largest > FAR_OUTSIDE:
        warn(
            f"{name} must be in or near [0, 1], got values up to {largest:g}; divide by the value of white, such as 255"
        )
    return largest > FAR_OUTSIDE


def check_fits(
    image: Tensor,
    size: tuple[int, ...],
    name: str,
    other: str,
    part: Tensor | None = None,
    *,
    channels: int | None = None,
    batch: int | None = None,
    empty: bool = False,
) -> None:
    """:func:`check_image` and :func:`check_same_size` for an image (B, C, *size), or (B, C, N) with N points in all."""
    flat = isinstance(image, Tensor) and image.ndim == 3 and image.shape[2] == math.prod(size)
    expected = (math.prod(size),) if flat else tuple(size)
    check_image(image, name, channels=channels, batch=batch, empty=empty, dimensions=(len(expected) + 2,))
    check_same_size(image, expected, name, other, part)


def check_same_device(tensor: Tensor, part: Tensor, name: str, other: str) -> None:
    """Raise unless ``tensor`` is on the device of ``part``, a part of ``other``."""
    if tensor.device != part.device:
        raise ValueError(
            f"{name} must be on the device of the {other}, {part.device}, got {tensor.device}; move one by .to()"
        )


def check_same_size(tensor: Tensor, size: tuple[int, ...], name: str, other: str, part: Tensor | None = None) -> None:
    """Raise unless the last dimensions of ``tensor`` are ``size``, and it is on the device of ``part`` if given."""
    if part is not None:
        check_same_device(tensor, part, name, other)
    actual = tuple(tensor.shape[-len(size) :])
    if actual != tuple(size):
        extent = {1: "number of points", 2: "height and width"}.get(len(size), "size")
        raise ValueError(
            f"{name} must have the {extent} of the {other}, {spelled(size)}, got {spelled(actual)}; resize one of them"
        )


def spelled(size: Sequence[int]) -> str:
    """A size in words, such as 32x48."""
    return "x".join(map(str, size))


def check_patch_size(patch_size: int) -> None:
    """Raise unless ``patch_size`` is an odd positive integer of at most :data:`LARGEST_PATCH`."""
    if not is_integer(patch_size):
        raise TypeError(f"patch_size must be an int, got {type(patch_size).__name__}; pass 1, 3, 5, ...")
    if patch_size < 1 or patch_size % 2 == 0:
        remedy = f"try {min(abs(patch_size) // 2 * 2 + 1, LARGEST_PATCH)}"
        raise ValueError(f"patch_size must be odd and at least 1, got {described(patch_size)}; {remedy}")
    if patch_size > LARGEST_PATCH:
        raise ValueError(
            f"patch_size must be at most {LARGEST_PATCH}, got {described(patch_size)}; downscale the image instead"
        )


def check_choice(value: object, name: str, choices: Sequence[str], remedy: str = "choose one of these") -> None:
    """Raise unless ``value`` is one of ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {described(value)}; {remedy}")


def described(value: object) -> str:
    """Describe a value of any type in one line, for error messages."""
    if isinstance(value, int) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"
    if is_number(value) and not isinstance(value, int | float):
        return repr(value.item())  # of numpy
    return repr(value) if value is None or isinstance(value, str | int | float) else type(value).__name__


def is_number(value: object) -> TypeGuard[float]:
    """Whether this is a number of Python or numpy, of any precision, but not a bool."""
    if isinstance(value, int | float):
        return not isinstance(value, bool)
    return isinstance(value, Real) and type(value).__module__ == "numpy"


def is_integer(value: object) -> TypeGuard[int]:
    """Whether this is an integer of Python or numpy."""
    return is_number(value) and isinstance(value, Integral)


def check_number(value: object, name: str, remedy: str = "pass a float") -> None:
    """Raise unless ``value`` is a number (tensors are not accepted)."""
    if not is_number(value):
        raise TypeError(f"{name} must be a number, got {type(value).__name__}; {remedy}")


def check_positive(value: float | Tensor, name: str, batch: int | None = None) -> None:
    """Raise unless ``value`` is positive and finite; see :func:`check_values`."""
    check_values(value, name, "positive", batch)


def check_values(value: object, name: str, domain: str, batch: int | None = None, remedy: str = "") -> None:
    """Raise unless ``value`` is a number or a tensor, () or (batch,), in a domain named in :data:`DOMAINS`.

    A tensor (batch, 1, 1, 1) is taken for (batch,).

    The values of a tensor are not checked if :func:`~nlfilter_torch.core.torch_internals.is_hidden`.
    """
    wanted, inside, usual = DOMAINS[domain]
    remedy = remedy or usual
    if not isinstance(value, Tensor):
        if not is_number(value):
            raise TypeError(f"{name} must be a number or a tensor, got {type(value).__name__}; pass a number")
        # Python integers may exceed the range of floats and the 64 bits of torch.
        finite = abs(value) < 1 << 63 if isinstance(value, int) else math.isfinite(value)
        if not (inside(value) and finite):
            raise ValueError(f"{name} must be {wanted}, got {described(value)}; {remedy}")
        return
    check_tensor(value, name)
    if value.dtype == torch.bool or value.dtype.is_complex:
        raise TypeError(f"{name} must be a number or a tensor of real numbers, got {value.dtype}; convert it")
    if value.numel() != 1 and (batch is None or tuple(value.shape) not in ((batch,), (batch, 1, 1, 1))):
        shapes = "()" if batch is None else f"() or ({batch},)"
        raise ValueError(f"{name} must be a number or have shape {shapes}, got {tuple(value.shape)}; reshape it")
    if is_hidden(value):
        return
    values = value.detach()
    if not bool((inside(values) & torch.isfinite(values)).all()):
        wrong = values if values.numel() <= SHOWN else values[~(inside(values) & torch.isfinite(values))][0]
        raise ValueError(f"{name} must be {wanted}, got {wrong.tolist()}; {remedy}")


def check_pair(value: object, name: str) -> None:
    """Raise unless ``value`` is a pair of non-negative integers."""
    if not isinstance(value, tuple | list) or not all(map(is_integer, value)):
        raise TypeError(f"{name} must be a pair of ints, got {described(value)}; pass (0, 0) for none")
    if len(value) != 2 or not all(0 <= v < 1 << 63 for v in value):
        numbers = ", ".join(map(described, value))
        raise ValueError(f"{name} must be two ints of at least 0, got ({numbers}); pass (0, 0) for none")


def check_reach(value: float, name: str, size: tuple[int, int]) -> None:
    """Raise if a blur radius of ``value`` pixels exceeds half the short side, as time and memory grow with it."""
    most = max(min(size) / 2, 2.0)  # defaults must be valid for tiny images too
    if not value <= most:
        limit = f"half the short side of the image, {most:g} pixels"
        raise ValueError(f"{name} must be at most {limit}, got {described(value)}; lower it")


def check_scale(bandwidth: float | Tensor, name: str, largest: Sequence[float], dtype: torch.dtype, what: str) -> None:
    """Raise if squares of features overflow in ``dtype``.

    Features have magnitudes up to ``largest``, of each image, over the bandwidth. Skipped if the bandwidth is hidden,
    see :func:`~nlfilter_torch.core.torch_internals.is_hidden`.
    """
    if isinstance(bandwidth, Tensor) and is_hidden(bandwidth):
        return
    values = bandwidth.detach().reshape(-1).tolist() if isinstance(bandwidth, Tensor) else [bandwidth]
    limits = torch.finfo(dtype)
    for value, most in zip(cycle(values), largest, strict=False):
        # Squared differences of features are summed; the margin allows for gradients.
        least = max(most / (limits.max**0.5 / 64), 4 * limits.tiny)
        if value < least:  # the message shows two digits, rounded up
            raise ValueError(
                f"{name} must be at least {1.06 * least:.2g} for {what} up to {most:.2g}, got {value:.2g}; raise it"
            )


def check_count(value: object, name: str, *, least: int = 1, most: int | None = None) -> None:
    """Raise unless ``value`` is an integer from ``least`` (default 1) to ``most``."""
    if not is_integer(value):
        raise TypeError(f"{name} must be an int, got {type(value).__name__}; pass a positive integer")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {described(value)}; pass a positive integer")
    if most is not None and value > most:
        raise ValueError(f"{name} must be at most {most}, got {described(value)}; lower it")


def check_order(order: int) -> None:
    """Raise unless ``order``, a number of products with W, is an integer from 1 to :data:`LARGEST_ORDER`."""
    check_count(order, "order", most=LARGEST_ORDER)


def check_shape(tensor: Tensor, shape: tuple[int, ...], name: str, remedy: str) -> None:
    """Raise unless ``tensor`` is a tensor of the given shape."""
    check_tensor(tensor, name, remedy)
    if tensor.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}; {remedy}")


def check_coefficients(coefficients: Tensor, factor: Tensor) -> None:
    """Raise unless coefficients (b, C, M) in float64 fit a factor (B, M, N)."""
    check_tensor(coefficients, "coefficients", "use spectrum.coefficients(image)")
    batch, count, _ = factor.shape
    shape = tuple(coefficients.shape)
    if coefficients.ndim != 3 or shape[2] != count or 0 in shape or (shape[0] != batch and 1 not in (batch, shape[0])):
        raise ValueError(
            f"coefficients must have shape ({batch}, C, {count}), got {shape}; use spectrum.coefficients(image)"
        )
    if coefficients.dtype != torch.float64:
        raise TypeError(f"coefficients must have dtype torch.float64, got {coefficients.dtype}; convert them")
    check_finite(coefficients, "coefficients")


def checked_response(response: Response, support: Tensor | None = None, dtype: torch.dtype | None = None) -> Response:
    """Wrap a function from eigenvalues (B, R) to gains so that its results are checked.

    Args:
        response: the function.
        support: (B, M) bool, where gains of so many eigenvalues must be finite; None means everywhere.
        dtype: in which the function receives eigenvalues; None leaves them as they are.
    """
    if not callable(response):
        raise TypeError(
            f"response must be a function of the eigenvalues, got {type(response).__name__}; "
            "pass a function such as torch.sqrt"
        )
    return partial(_gains, response, support, dtype)


def _gains(response: Response, support: Tensor | None, dtype: torch.dtype | None, eigenvalues: Tensor) -> Tensor:
    """Compute and check the gains of eigenvalues (B, R)."""
    remedy = "return one gain for every eigenvalue"
    gains = response(eigenvalues if dtype is None else eigenvalues.to(dtype))
    check_tensor(gains, "response", remedy)
    if gains.dtype.is_complex:
        raise TypeError(f"response must be real, got {gains.dtype}; {remedy}")
    if gains.shape != eigenvalues.shape:
        raise ValueError(
            f"response must return a tensor with the shape of its argument, {tuple(eigenvalues.shape)}, "
            f"got {tuple(gains.shape)}; {remedy}"
        )
    if support is None:
        check_finite(gains, "response")
    elif eigenvalues.shape == support.shape:
        check_finite(torch.where(support, gains.detach(), 0), "response")
    return gains if gains.is_floating_point() else gains.to(dtype or eigenvalues.dtype)


def check_alpha(alpha: Tensor, *, dimensions: Sequence[int] = (1, 2, 4)) -> None:
    """Raise unless ``alpha`` holds at least two sliders: (k+1,), (B, k+1) or, if allowed, (B, k+1) planes."""
    check_dtype(alpha, "alpha", "write 1.0 instead of 1")
    if alpha.ndim not in dimensions:
        shapes = {1: "(k+1,)", 2: "(B, k+1)"}
        wanted = " or ".join(shapes.get(n) or SHAPES.get(n, "(B, C, ...)").replace("C", "k+1") for n in dimensions)
        raise ValueError(f"alpha must have shape {wanted}, got {tuple(alpha.shape)}; reshape it")
    entries = alpha.shape[0] if alpha.ndim == 1 else alpha.shape[1]
    if entries < 2:
        raise ValueError(
            f"alpha must have at least two entries, got {entries}; give one per layer, such as (1, 1, 1, 1)"
        )
    check_finite(alpha, "alpha")


def check_eigenvalues(values: Tensor) -> None:
    """Raise unless eigenvalues are floating-point and small enough in magnitude for their powers to stay finite."""
    check_dtype(values, "eigenvalues", "convert them")
    check_finite(values, "eigenvalues")
    if is_hidden(values) or values.numel() == 0:
        return
    largest = float(values.detach().abs().max())
    if largest > LARGEST_EIGENVALUE:
        raise ValueError(
            f"eigenvalues must be in or near [0, 1], got values up to {largest:g}; divide by the largest one"
        )


def check_features(features: Tensor, name: str, size: int | None = None, *, empty: bool = False) -> None:
    """Raise unless ``features`` is a finite (B, D, N) tensor, with D = ``size`` if given; B may be 0 if ``empty``."""
    check_dtype(features, name, "convert them")
    if features.ndim != 3 or 0 in features.shape[empty:]:
        raise ValueError(
            f"{name} must have shape (B, D, N) with at least one point, got {tuple(features.shape)}; "
            "move points to the last dimension and add missing ones"
        )
    if size is not None and features.shape[1] != size:
        raise ValueError(
            f"{name} must have {size} features per point, as those from which the operator was built, got "
            f"{features.shape[1]}; compute them in the same way"
        )
    check_finite(features, name)


def check_size(size: object, points: int) -> tuple[int, ...]:
    """Return ``size``, with (N,) as (1, N); raise unless it holds positive integers whose product is ``points``."""
    if not isinstance(size, tuple | list) or len(size) == 0 or not all(map(is_integer, size)):
        raise TypeError(
            "size must be integers, such as (H, W), (D, H, W) or (N,), got "
            f"{size if isinstance(size, tuple) else described(size)}; pass ({points},), for example"
        )
    lengths = (1, *size) if len(size) == 1 else tuple(size)
    if min(lengths) < 1 or math.prod(lengths) != points:
        raise ValueError(
            f"size must have one pixel for each of the {points} points, got {spelled(lengths)}; "
            f"pass ({points},) for unordered points"
        )
    return lengths


def check_weights(weights: Tensor, features: Tensor) -> Tensor:
    """Return weights, (N,) or (B, N), as (B, N) in the dtype of features (B, D, N); raise unless all are in range."""
    check_tensor(weights, "weights")
    check_dtype(weights, "weights", "convert it with weights.float()")
    batch, _, points = features.shape
    if tuple(weights.shape) not in ((points,), (1, points), (batch, points)):
        raise ValueError(
            f"weights must have shape ({points},) or ({batch}, {points}), got {tuple(weights.shape)}; pass one each"
        )
    weights = weights.detach().to(features).expand(batch, points).clone(memory_format=torch.contiguous_format)
    _check_range_of_weights(weights)
    return weights


def check_pixel_weights(weights: Tensor, guide: Tensor, group: object = None) -> Tensor:
    """Return weights, (B, 1, H, W) or (1, 1, H, W), as (B, 1, H, W) in the dtype of the guide (B, C, H, W).

    Raises unless all are in range and some pixel of every image counts.
    """
    if group is not None:
        raise ValueError(
            "weights must be None for an image whose rows are distributed, since patches mirror at the edge of what "
            "counts, got a tensor; build the operator without a group"
        )
    check_tensor(weights, "weights")
    refuse_transforms(weights=weights)
    if torch.compiler.is_exporting():
        raise ValueError(
            "weights must be None in an exported program, since the number of pixels that count is read to choose "
            "landmarks, got a tensor; export with dynamic sizes instead of padding, or compile with torch.compile"
        )
    check_dtype(weights, "weights", "convert it with weights.float()")
    batch, _, *size = guide.shape
    if tuple(weights.shape) not in ((1, 1, *size), (batch, 1, *size)):
        raise ValueError(
            f"weights must have shape {(batch, 1, *size)}, a number for each pixel of the guide, got "
            f"{tuple(weights.shape)}; pass 1 for pixels that count and 0 for others"
        )
    if weights.device != guide.device:
        raise ValueError(
            f"weights must be on the device of the guide, {guide.device}, got {weights.device}; move one by .to()"
        )
    weights = (
        weights.detach()
        .to(torch.promote_types(guide.dtype, torch.float32))
        .expand(batch, 1, *size)
        .clone(memory_format=torch.contiguous_format)
    )
    _check_range_of_weights(weights)
    check_counted(weights.flatten(1).amax(1))
    return weights


def _check_range_of_weights(weights: Tensor) -> None:
    """Raise unless weights are 0 or neither tiny nor huge."""
    if is_hidden(weights) or weights.numel() == 0:
        return
    positive = (weights >= LEAST_WEIGHT) & (weights <= 1 / LEAST_WEIGHT)
    if not bool((positive | (weights == 0)).all()):
        allowed, actual = f"{LEAST_WEIGHT:g} to {1 / LEAST_WEIGHT:g}", "{:g} to {:g}".format(*weights.aminmax())
        raise ValueError(f"weights must be 0, or from {allowed}, got {actual}; set negligible ones to 0")


def check_counted(largest: Tensor) -> None:
    """Raise if the largest weight of an image, (B,), is 0."""
    if not is_hidden(largest) and not bool((largest > 0).all()):
        raise ValueError(
            "weights must be positive at some pixel of every image, got 0 everywhere in image(s) "
            f"{(largest <= 0).nonzero().squeeze(1).tolist()}; pass 1 for pixels that count"
        )
