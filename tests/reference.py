"""The paper's filter, dense and in float64 numpy: every n x n matrix is formed, without approximation.

It follows Talebi and Milanfar, "Nonlocal Image Editing"; equation numbers are the paper's. Pixels are numbered row
by row, a grey image y is a vector of n numbers, eigenvectors are the columns of V.

Three choices differ from the paper. Patch weights have unit sum, so that h_y is in the units of the image whatever the
patch size. The filter is balanced to rounding, not by a few sweeps. Diffusion maps use eigenvectors of unit RMS
(V sqrt(n)), since with unit-norm ones every distance vanishes as the image grows.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# ---------------------------------------------------------------------------------------------------------------------
# Section II: the global filter


def patch_weights(size: int, axes: int = 2) -> Array:
    """Gaussian window (size, size), or with more axes, with sigma = size / 4 and unit sum."""
    offsets = np.indices((size,) * axes) - size // 2
    window = np.exp(-(offsets**2).sum(0) / (2 * (size / 4) ** 2))
    return window / window.sum()


def pad(image: Array, margin: int) -> Array:
    """Reflect the borders of (H, W) or (D, H, W); an axis that is too short to be reflected is replicated."""
    for axis in range(image.ndim):
        widths = [(0, 0)] * image.ndim
        widths[axis] = (margin, margin)
        image = np.pad(image, widths, mode="reflect" if image.shape[axis] > margin else "edge")
    return image


def patches(image: Array, size: int) -> Array:
    """The patch around every pixel of (H, W) or (D, H, W), as rows (n, size^2) or (n, size^3)."""
    windows = np.lib.stride_tricks.sliding_window_view(pad(image, size // 2), (size,) * image.ndim)
    return windows.reshape(-1, size**image.ndim)


def features(guide: Array, patch_size: int, h_y: float, h_x: float | tuple[float, ...] | None = None) -> Array:
    """Rows x_i (n, D) for which the kernel is exp(-||x_i - x_j||^2). Eq. 1; for (C, H, W) the mean of eq. 18.

    Volumes are (C, D, H, W).
    """
    channels = guide[None] if guide.ndim == 2 else guide
    axes = channels.ndim - 1
    scale = np.sqrt(patch_weights(patch_size, axes).ravel() / len(channels)) / h_y
    columns = [patches(channel, patch_size) * scale for channel in channels]
    if h_x is not None:
        columns.append(np.indices(channels.shape[1:]).reshape(axes, -1).T / h_x)
    return np.concatenate(columns, axis=1)


def affinity(left: Array, right: Array) -> Array:
    """K_ij = exp(-||x_i - x_j||^2) between two sets of features, rows and columns. Eq. 1."""
    squared = (left**2).sum(1)[:, None] + (right**2).sum(1)[None, :] - 2 * left @ right.T
    return np.exp(-np.maximum(squared, 0))


def row_normalised(kernel: Array) -> Array:
    """W = D^-1 K, D the row sums of K. Eq. 2."""
    return kernel / kernel.sum(axis=1, keepdims=True)


def balanced(kernel: Array, steps: int = 50) -> Array:
    """The symmetric W = diag(d) K diag(d) with unit row sums, of which eq. 3 is the eigen-decomposition.

    Sinkhorn's iteration for one symmetric scaling, each step a geometric mean of the last one and the next.
    """
    d = kernel.sum(axis=1) ** -0.5
    for _ in range(steps):
        d = np.sqrt(d / (kernel @ d))
    return d[:, None] * kernel * d[None, :]


def filter_matrix(guide: Array, patch_size: int, h_y: float, h_x: float | None = None) -> Array:
    """The dense W of an image, (n, n): symmetric, doubly stochastic, positive semi-definite."""
    x = features(guide, patch_size, h_y, h_x)
    return balanced(affinity(x, x))


def eigenpairs(w: Array) -> tuple[Array, Array]:
    """S (n,) in decreasing order and V (n, n) with W = V diag(S) V^T. Eq. 3."""
    s, v = np.linalg.eigh(w)
    return s[::-1].clip(0, 1), v[:, ::-1]


def truncated(s: Array, v: Array, m: int) -> tuple[Array, Array]:
    """The m leading eigenpairs: W_m = V_m S_m V_m^T. Eq. 4."""
    return s[:m], v[:, :m]


# ---------------------------------------------------------------------------------------------------------------------
# Section II-C: the paper's own approximation


def uniform_samples(height: int, width: int, m: int) -> NDArray[np.int64]:
    """Indices of m pixels on a spatial grid, in rows of nearly equal length (set A)."""
    rows = min(max(round((m * height / width) ** 0.5), 1), m)
    grid = []
    for row, share in enumerate(np.array_split(np.arange(m), rows)):
        y = int((row + 0.5) * height / rows)
        grid.extend(y * width + int((k + 0.5) * width / len(share)) for k in range(len(share)))
    return np.array(grid)


def nystrom_blocks(x: Array, samples: NDArray[np.int64], steps: int = 100) -> tuple[Array, Array]:
    """W_A (m, m) and W_AB (m, n - m) of m sampled rows of the kernel. Fig. 2.

    Where a pixel resembles no sample, its row of the extended kernel is about zero and may have a negative sum:
    then the scaling, and everything that follows, is NaN. This is a property of the method, and is left unchanged.
    """
    a, b = samples, np.setdiff1d(np.arange(len(x)), samples)
    k_a, k_ab = affinity(x[a], x[a]), affinity(x[a], x[b])  # (m, m), (m, n - m)
    pi, phi = positive_part(k_a)
    extended = np.concatenate([phi, k_ab.T @ phi / pi])  # eigenvectors of K_A, extended to B
    r = c = np.ones(len(x))
    for _ in range(steps):  # Sinkhorn, rows and columns in turn, on the extended kernel
        c = 1 / (extended @ (pi * (extended.T @ r)))
        r = 1 / (extended @ (pi * (extended.T @ c)))
    d = np.sqrt(r * c)
    return d[: len(a), None] * k_a * d[: len(a)], d[: len(a), None] * k_ab * d[len(a) :]


def nystrom_eigenpairs(x: Array, samples: NDArray[np.int64], steps: int = 100) -> tuple[Array, Array]:
    """S (r,) and V (n, r) from the blocks of m sampled rows. Fig. 2, eq. 5 and 6."""
    a, b = samples, np.setdiff1d(np.arange(len(x)), samples)
    w_a, w_ab = nystrom_blocks(x, samples, steps)
    root = inverse_root(w_a)
    s, u = positive_part(w_a + root @ w_ab @ w_ab.T @ root)  # Q of Fig. 2
    v = np.empty((len(x), len(s)))
    v[a], v[b] = (w_a @ root @ u) / np.sqrt(s), (w_ab.T @ root @ u) / np.sqrt(s)
    return s, v


def positive_part(matrix: Array, tolerance: float = 1e-10) -> tuple[Array, Array]:
    """Return the eigenvalues above the tolerance, decreasing, and their eigenvectors."""
    s, v = np.linalg.eigh((matrix + matrix.T) / 2)
    keep = s > tolerance * s[-1]
    return s[keep][::-1], v[:, keep][:, ::-1]


def inverse_root(matrix: Array) -> Array:
    """M^(-1/2) on the positive part of a symmetric matrix."""
    s, v = positive_part(matrix)
    return (v / np.sqrt(s)) @ v.T


# ---------------------------------------------------------------------------------------------------------------------
# Section III: mapping the eigenvalues


def response(eigenvalues: Array, alpha: Array) -> Array:
    """f(lambda) with f(0) = alpha_1 and f(1) = alpha_{k+1}. Eq. 14."""
    powers = eigenvalues[..., None] ** np.arange(1, len(alpha))
    return alpha[0] + powers @ np.diff(alpha)


def layers(w: Array, y: Array, order: int) -> Array:
    """The k detail layers W^(i-1) (I - W) y and the smooth one W^k y, (k + 1, n). Eq. 11, Fig. 4."""
    smooth = [y]
    for _ in range(order):
        smooth.append(w @ smooth[-1])
    return np.array([fine - coarse for fine, coarse in pairwise(smooth)] + smooth[-1:])


def edited(w: Array, y: Array, alpha: Array) -> Array:
    """The weighted sum of the layers. Eq. 12."""
    return alpha @ layers(w, y, len(alpha) - 1)


def spectral_function(s: Array, v: Array, f_of_s: Array, y: Array) -> Array:
    """V f(S) V^T y for the mapped eigenvalues f(S). Eq. 10."""
    return v @ (f_of_s * (v.T @ y))


def polynomial_filter(s: Array, v: Array, y: Array, alpha: Array) -> Array:
    """V f(S) V^T y with the polynomial of eq. 14, which drops what V does not span. Eq. 13."""
    return spectral_function(s, v, response(s, alpha), y)


# ---------------------------------------------------------------------------------------------------------------------
# Section IV: the globalizing mask


def diffusion_map(s: Array, v: Array, time: float) -> Array:
    """Psi_t (n, m - 1): the eigenvectors but the constant one, weighted by lambda^t. Eq. 15, unit RMS."""
    return s[1:] ** time * v[:, 1:] * np.sqrt(len(v))


def diffusion_distance(psi: Array, point: Array) -> Array:
    """D_t^2 (n,) of every pixel to a point of the map. Eq. 16."""
    return ((psi - point) ** 2).sum(axis=1)


def diffusion_mask(s: Array, v: Array, region: Array, time: float, width: float) -> Array:
    """M_t (n,): exp(-D_t^2 / width) to the average map of a region (n,). Eq. 17, whose width is 1."""
    psi = diffusion_map(s, v, time)
    return np.exp(-diffusion_distance(psi, region @ psi / region.sum()) / width)


def segment_mask(s: Array, v: Array, regions: Array, time: float, steps: int = 100) -> Array:
    """Binary masks (K, n): k-means of the diffusion map from the centres of the regions (K, n). Sec. V-A."""
    psi = diffusion_map(s, v, time)
    centres = regions @ psi / regions.sum(axis=1, keepdims=True)
    for _ in range(steps):
        label = ((psi[None] - centres[:, None]) ** 2).sum(axis=2).argmin(axis=0)
        centres = np.array([psi[label == k].mean(axis=0) for k in range(len(regions))])
    return (label[None] == np.arange(len(regions))[:, None]).astype(np.float64)


# ---------------------------------------------------------------------------------------------------------------------
# Appendices: the share of the image that the eigenvectors capture


def captured_energy(v: Array, y: Array) -> float:
    """beta = ||V^T y||^2 / ||y||^2. Eq. 19."""
    return float(((v.T @ y) ** 2).sum() / (y**2).sum())


def relative_rmse(v: Array, y: Array) -> float:
    """||y - V V^T y|| / ||y|| in per cent. Appendix B, Fig. 20."""
    return float(np.linalg.norm(y - v @ (v.T @ y)) / np.linalg.norm(y) * 100)


# ---------------------------------------------------------------------------------------------------------------------
# Refinement of probabilities, which is not in the paper


def mean_field(w: Array, logits: Array, strength: float, steps: int) -> Array:
    """Probabilities (n, K) after mean-field steps from logits (n, K): q <- softmax(logits + strength W q)."""

    def softmax(values: Array) -> Array:
        powers = np.exp(values - values.max(1, keepdims=True))
        return powers / powers.sum(1, keepdims=True)

    q = softmax(logits)
    for _ in range(steps):
        q = softmax(logits + strength * (w @ q))
    return q
