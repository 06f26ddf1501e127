"""Kernels in C for what filters on processors spend their time in; without them torch does the same, more slowly.

They are compiled when the package is installed (``hatch_build.py``), for Linux on x86-64, where there is GCC. Nothing
is compiled or looked for later. They take single precision only and are hidden from autograd: callers ask
:func:`suits`.
"""

import ctypes
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.checks import is_transformed

if TYPE_CHECKING:
    from nlfilter_torch.core.kernels.affinity import Affinity

SMALL = 1 << 15  # numbers of a factor below which a second thread takes longer to call than it saves
LEVELS = instruction_sets.NAMES

_POINTER, _LONG, _INT, _FLOAT = ctypes.c_void_p, ctypes.c_long, ctypes.c_int, ctypes.c_float


def _load() -> ctypes.CDLL | None:
    """The compiled library, if the installation has one."""
    library = instruction_sets.load_library()
    if library is None:
        return None
    shared: list[Any] = [_INT, _INT, _LONG]  # instruction set, threads, pixels
    share_threads(library, _openmp())
    planes: list[Any] = [_POINTER, _LONG, _LONG]  # (B, R, N) and their strides
    columns: list[Any] = [*shared, _LONG, _LONG, _LONG, *planes, *[_POINTER] * 3, _FLOAT, _INT, *planes, _POINTER]
    library.nlfilter_columns.argtypes = columns
    library.nlfilter_backward.argtypes = [*columns, _LONG, _POINTER, *planes, *[_POINTER] * 4]
    factor: list[Any] = [_LONG, _LONG, *planes]  # images, landmarks, (B, M, N)
    library.nlfilter_spread.argtypes = [*shared, *factor, _LONG, *[_POINTER] * 3]
    library.nlfilter_gather.argtypes = [*shared, *factor, _LONG, *planes, _POINTER]
    library.nlfilter_sweep.argtypes = [*shared, *factor, *[_POINTER] * 3, _FLOAT, _POINTER, _POINTER]
    library.nlfilter_lloyd.argtypes = [*shared, *[_LONG] * 4, _FLOAT, *[_POINTER] * 3]
    library.nlfilter_pivots.argtypes = [*shared, *[_LONG] * 3, _FLOAT, *[_POINTER] * 3]
    library.nlfilter_grams.argtypes = [*shared, *factor, _LONG, *[_POINTER] * 3]
    return library


def _openmp() -> Any:
    """The function by which torch's own OpenMP library runs another on its threads; None where it is not found."""
    maps = Path("/proc/self/maps").read_text().splitlines()
    loaded = {line.split(maxsplit=5)[5] for line in maps if "omp" in line.rpartition("/")[2] and ".so" in line}
    for path in sorted(loaded, key=lambda path: "torch" not in path):  # other packages may have brought their own
        function = getattr(ctypes.CDLL(path), "GOMP_parallel", None)
        if function is not None:
            return function
    return None


def share_threads(library: ctypes.CDLL, openmp: Any) -> None:
    """Let kernels run on the threads of an OpenMP library, by its ``GOMP_parallel``; None has them start their own."""
    library.nlfilter_share_threads(ctypes.cast(openmp, _POINTER) if openmp is not None else None)


_library = _load()
level = instruction_sets.level(_library)  # of LEVELS, what this processor and installation can do


def suits(*tensors: Tensor) -> bool:
    """Whether the kernels can work on such tensors: plain float32 on the processor, not empty, without derivatives."""
    if not level or torch.compiler.is_compiling():
        return False
    return all(
        type(tensor) in (Tensor, torch.nn.Parameter)
        and tensor.dtype == torch.float32
        and tensor.device.type == "cpu"
        and tensor.numel() > 0
        and not is_transformed(tensor)
        and not (tensor.requires_grad and torch.is_grad_enabled())
        and not tensor.is_neg()
        and forward_ad.unpack_dual(tensor).tangent is None
        for tensor in tensors
    )


def columns(
    features: Tensor, affinity: "Affinity", whitening: Tensor, *, limited: bool, out: Tensor, norms: Tensor
) -> None:
    """Columns of the Nystrom factor, written to ``out``.

    Args:
        features: (B, D, N).
        affinity: to the landmarks.
        whitening: (B, M, M).
        limited: whether columns are shortened to norm 1.
        out: (B, M, N), rows in one piece.
        norms: (B, N), in one piece; takes the squared norms of columns before they are shortened, if they are.
    """
    features = _by_rows(features)
    centre, landmarks, whitening = _contiguous(affinity.centre, affinity.rows, whitening)
    batch, size, pixels = features.shape
    _run(
        "columns", _threads(out), pixels, batch, size, out.shape[1], *_place(features), centre.data_ptr(),
        landmarks.data_ptr(), whitening.data_ptr(), affinity.floor, limited, *_place(out), norms.data_ptr(),
    )  # fmt: skip


def columns_backward(
    features: Tensor,
    affinity: "Affinity",
    whitening: Tensor,
    *,
    limited: bool,
    factor: Tensor,
    scale: Tensor,
    gradient: Sequence[Tensor],
    diagonal: Tensor,
    points: Tensor,
    out: Tensor,
) -> tuple[Tensor, Tensor]:
    """Derivatives of :func:`columns`.

    Args:
        features: (B, D, N).
        affinity: to the landmarks.
        whitening: (B, M, M).
        limited: whether columns were shortened to norm 1.
        factor: (B, M, N), the columns.
        scale: (B, N), what they were shortened by.
        gradient: of the loss by the columns, (B, M, r) and (B, r, N) whose product it is, or itself alone, (B, M, N).
        diagonal: (B, N), of the loss by 1 - |u|^2 where that is not negative.
        points: (B, D + 1, M); their products with the derivatives by the exponents move the features.
        out: (B, D, N), in one piece; takes the derivatives by the features.

    Returns:
        The derivative by the whitening, (B, M, M), of lower triangles that of their own entries alone, and the products
        (B, M, D + 1) of the derivatives by the exponents with the features from the centre and with 1; in float64.
    """
    features, factor, right = map(_by_rows, (features, factor, gradient[-1]))
    left = gradient[0].contiguous() if len(gradient) == 2 else None
    centre, landmarks, whitening, points = _contiguous(affinity.centre, affinity.rows, whitening, points)
    scale, diagonal = _contiguous(scale, diagonal)
    (batch, size, pixels), marks = features.shape, factor.shape[1]
    sums = torch.empty(batch, marks * (marks + size + 1), dtype=torch.float64)
    _run(
        "backward", _threads(factor), pixels, batch, size, marks, *_place(features), centre.data_ptr(),
        landmarks.data_ptr(), whitening.data_ptr(), affinity.floor, limited, *_place(factor), scale.data_ptr(),
        right.shape[1], None if left is None else left.data_ptr(), *_place(right), diagonal.data_ptr(),
        points.data_ptr(), out.data_ptr(), sums.data_ptr(),
    )  # fmt: skip
    by_whitening, products = sums.split([marks * marks, marks * (size + 1)], dim=1)
    return by_whitening.unflatten(1, (marks, marks)), products.unflatten(1, (marks, size + 1))


def spread(rows: Tensor, factor: Tensor, scaling: Tensor | None = None) -> Tensor:
    """``rows @ factor``, (B, R, N), of rows (B, R, M) and a factor (B, M, N), times a scaling (B, N)."""
    factor = _by_rows(factor)
    batch, marks, pixels = factor.shape
    rows = rows.expand(batch, -1, marks).contiguous()
    scaling = None if scaling is None else scaling.expand(batch, pixels).contiguous()
    out = factor.new_empty(batch, rows.shape[1], pixels)
    _call(
        "spread", factor, rows.shape[1], rows.data_ptr(), None if scaling is None else scaling.data_ptr(),
        out.data_ptr(),
    )  # fmt: skip
    return out


def gather(images: Tensor, factor: Tensor) -> Tensor:
    """``images @ factor^T``, (B, R, M) in float64, of images (B, R, N) and a factor (B, M, N)."""
    factor = _by_rows(factor)
    batch, marks, pixels = factor.shape
    images = _by_rows(images.expand(batch, -1, pixels))
    out = factor.new_empty(batch, images.shape[1], marks, dtype=torch.float64)
    _call("gather", factor, images.shape[1], *_place(images), out.data_ptr())
    return out


def sweep(factor: Tensor, diagonal: Tensor, half: Tensor, most: float) -> tuple[Tensor, Tensor]:
    """The scaling d of every pixel for a guess at its moment, and the moment that it has.

    Args:
        factor: (B, M, N).
        diagonal: (B, N).
        half: of the guess t, (B, M).
        most: of d.

    Returns:
        d (B, N), and factor @ d (B, M) in float64.
    """
    return _sweep(factor, half, None, diagonal, most)


def weigh(factor: Tensor, weights: Tensor, vector: Tensor) -> Tensor:
    """``factor diag(weights) factor^T vector``, (B, M) in float64, of a factor (B, M, N), (B, N) and (B, M)."""
    return _sweep(factor, vector, weights, None, 0.0)[1]


def _sweep(
    factor: Tensor, row: Tensor, scaling: Tensor | None, diagonal: Tensor | None, most: float
) -> tuple[Tensor, Tensor]:
    factor = _by_rows(factor)
    batch, marks, pixels = factor.shape
    row = row.expand(batch, marks).contiguous()
    scaling, diagonal = (t if t is None else t.expand(batch, pixels).contiguous() for t in (scaling, diagonal))
    out = factor.new_empty(batch, pixels)
    moment = factor.new_empty(batch, marks, dtype=torch.float64)
    _call(
        "sweep", factor, row.data_ptr(), *(t if t is None else t.data_ptr() for t in (scaling, diagonal)), most,
        out.data_ptr(), moment.data_ptr(),
    )  # fmt: skip
    return out, moment


def lloyd(points: Tensor, start: Tensor, iterations: int, margin: float) -> Tensor:
    """The nearest centre (B, S) to each of the points (B, D, S), after steps of Lloyd's from the centres (B, D, M).

    The first of those that are as near but for ``margin`` times the terms of which scores are the sums.
    """
    points, start = points.contiguous(), start.contiguous()
    batch, size, count = points.shape
    nearest = torch.empty(batch, count, dtype=torch.int32)
    _run(
        "lloyd", torch.get_num_threads(), batch, size, count, start.shape[2], iterations, margin, points.data_ptr(),
        start.data_ptr(), nearest.data_ptr(),
    )  # fmt: skip
    return nearest.long()


def pivots(points: Tensor, draws: Tensor, explained: float) -> Tensor:
    """Pivots (B, M) of a random Cholesky decomposition of the affinities of points (B, D, S).

    Args:
        points: (B, D, S).
        draws: (M,) in [0, 1), what each pivot is drawn by.
        explained: a residual of the unit diagonal that counts as none.
    """
    points, draws = points.contiguous(), draws.contiguous()
    batch, size, count = points.shape
    found = torch.empty(batch, len(draws), dtype=torch.long)
    arguments = (size, count, len(draws), explained, points.data_ptr(), draws.data_ptr(), found.data_ptr())
    _run("pivots", torch.get_num_threads(), batch, *arguments)
    return found


def grams(factor: Tensor, scaling: Tensor, remainder: Tensor, count: int) -> Tensor:
    """``F diag(r^j) F^T`` for j = 0 to count - 1 and F = factor diag(d), (B, count, M, M) in float64.

    Args:
        factor: (B, M, N).
        scaling: d, (B, N).
        remainder: r, (B, N).
        count: of the powers.
    """
    factor = _by_rows(factor)
    scaling, remainder = _contiguous(scaling, remainder)
    batch, marks, _ = factor.shape
    out = factor.new_empty(batch, count, marks, marks, dtype=torch.float64)
    _call("grams", factor, count, scaling.data_ptr(), remainder.data_ptr(), out.data_ptr())
    return out


def _by_rows(planes: Tensor) -> Tensor:
    """Planes (B, R, N) with each of their rows in one piece, however far they are apart."""
    return planes if planes.stride(2) == 1 else planes.contiguous()


def _contiguous(*tensors: Tensor) -> Iterator[Tensor]:
    return (tensor.contiguous() for tensor in tensors)


def _place(planes: Tensor) -> tuple[int, int, int]:
    """Where planes (B, R, N) with rows in one piece are, and how far images and rows are apart."""
    return planes.data_ptr(), planes.stride(0), planes.stride(1)


def _threads(factor: Tensor) -> int:
    """As many as torch would use, but for small work."""
    return 1 if factor.numel() < SMALL else torch.get_num_threads()


def _call(name: str, factor: Tensor, *arguments: int | float | None) -> None:
    """Run a kernel on all pixels of a factor (B, M, N)."""
    batch, marks, pixels = factor.shape
    _run(name, _threads(factor), pixels, batch, marks, *_place(factor), *arguments)


def _run(name: str, threads: int, count: int, *arguments: int | float | None) -> None:
    if getattr(_library, f"nlfilter_{name}")(level, threads, count, *arguments):
        raise MemoryError("no memory is left for the buffers of a few rows; make the image smaller")
