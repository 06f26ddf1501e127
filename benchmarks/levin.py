"""Levin, Lischinski and Weiss, "Colorization using Optimization", SIGGRAPH 2004, the paper's [29], in scipy.sparse.

The chroma of a pixel is the weighted mean of the chroma of its eight neighbours, with weights that decrease with the
difference in luminance relative to its local variance; painted pixels keep their chroma. One sparse system is factored
once and solved for both channels.
"""

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as solvers
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHARE_OF_VARIANCE = 0.6  # the constants of the authors' own program
LEAST_WEIGHT = 0.01  # of the most similar neighbour
LEAST_VARIANCE = 2e-6


def neighbours(luminance: Array) -> tuple[Array, NDArray[np.int64]]:
    """Luminance and index of every pixel in the 3x3 window, (9, H, W); NaN and -1 outside the image."""
    height, width = luminance.shape
    values = np.pad(luminance, 1, constant_values=np.nan)
    indices = np.pad(np.arange(height * width).reshape(height, width), 1, constant_values=-1)
    windows = [(dy, dx) for dy in range(3) for dx in range(3)]
    cut = [(slice(dy, dy + height), slice(dx, dx + width)) for dy, dx in windows]
    return np.stack([values[c] for c in cut]), np.stack([indices[c] for c in cut])


def system(luminance: Array, painted: NDArray[np.bool_]) -> sparse.csc_matrix:
    """The matrix (N, N): identity minus weights, and only the identity in rows of painted pixels."""
    values, indices = neighbours(luminance)
    squared = (values - luminance) ** 2
    variance = SHARE_OF_VARIANCE * np.nanvar(values, axis=0)
    nearest = np.nanmin(np.delete(squared, 4, axis=0), axis=0)
    variance = np.maximum(np.maximum(variance, -nearest / np.log(LEAST_WEIGHT)), LEAST_VARIANCE)
    weights = np.exp(-squared / variance)
    weights[4] = 0  # the pixel itself
    weights = np.nan_to_num(weights)
    weights /= weights.sum(axis=0)
    weights[:, painted] = 0
    there = (indices >= 0) & (weights > 0)
    rows = np.broadcast_to(indices[4], indices.shape)[there]
    count = luminance.size
    return sparse.identity(count, format="csc") - sparse.csc_matrix(
        (weights[there], (rows, indices[there])), shape=(count, count)
    )


def propagate(luminance: Array, chroma: Array, painted: NDArray[np.bool_]) -> Array:
    """Solve for the chroma (C, H, W) of the image, given ``chroma`` (C, H, W) where ``painted`` (H, W)."""
    factors = solvers.splu(system(luminance, painted))
    return np.stack([factors.solve((c * painted).ravel()).reshape(c.shape) for c in chroma])
