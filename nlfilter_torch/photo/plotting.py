"""Labelled figures of images, layers, eigenvectors, masks and responses. Needs the ``cli`` extra (matplotlib).

Every function returns a matplotlib figure outside of pyplot's global state; :func:`save_figure` writes it. ``side`` is
the length in pixels of the longer side of each picture.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.filtering.filters import polynomial_response
from nlfilter_torch.operator.spectrum import Spectrum
from nlfilter_torch.photo.files.writing import open_beside

DPI = 100
POINTS = 72  # typographic points per inch
PANEL_SIDE = 512  # pixels along the longer side of a picture
LABEL = 35  # pixels above a picture for its title
BREADTH, LINE = 0.6, 1.2  # width of a letter and height of a line, relative to the letter height
GAP = 15  # pixels between pictures
FAR = 0.995  # colour scales end at this quantile, so that one outlier does not compress the others


def show_images(
    images: Mapping[str, Tensor], *, columns: int | None = None, side: int = PANEL_SIDE, letters: int | None = None
) -> Figure:
    """Draw titled pictures side by side.

    Args:
        images: each (1, C, H, W) or (C, H, W) in [0, 1], by its title.
        columns: Pictures in a row; None is all.
        side: Length in pixels of the longer side of each picture.
        letters: Letter height of the titles in pixels; titles are wrapped to the width of the pictures. None is a
            single line in a size that fits.
    """
    pictures = {title: _picture(image) for title, image in images.items()}
    shape = next(iter(pictures.values())).shape
    if letters is None:
        titles, label = list(pictures), LABEL
    else:
        width = shape[1] * side / max(shape[:2])
        titles = ["\n".join(textwrap.wrap(title, max(6, int(width / (letters * BREADTH))))) for title in pictures]
        label = round(letters * (0.8 + LINE * max(title.count("\n") + 1 for title in titles)))
    figure, axes = _panels(shape, len(pictures), columns, side, label)
    for axis, title, picture in zip(axes, titles, pictures.values(), strict=True):
        _draw(axis, title, picture, letters=letters)
    return figure


def show_layers(layers: Tensor, *, side: int = PANEL_SIDE) -> Figure:
    """Draw detail layers (1, k+1, C, H, W) from fine to coarse, around mid-grey, and the last layer unchanged."""
    stack = layers[0].mean(1).numpy(force=True)  # (k+1, H, W)
    figure, axes = _panels(stack.shape[1:], len(stack), columns=math.ceil(math.sqrt(len(stack))), side=side)
    for number, (axis, layer) in enumerate(zip(axes, stack[:-1], strict=False), start=1):
        limit = _limit(layer)
        name = {1: " (finest)", len(stack) - 1: " (coarsest)"}.get(number, "")
        _draw(axis, f"Layer {number}{name}, ±{255 * limit:.0f} levels of 255", layer, limit=limit)
    _draw(axes[-1], f"Layer {len(stack)}: the smooth rest", stack[-1].clip(0, 1))
    return figure


def show_eigenvectors(
    spectrum: Spectrum, numbers: Sequence[int] = (2, 3, 4, 5, 7, 10, 20, 35, 50), *, side: int = PANEL_SIDE
) -> Figure:
    """Draw eigenvectors, numbered from 1, as in the paper's Fig. 1; numbers beyond the last are left out.

    If none remains, as for a flat picture, the first, constant eigenvector is drawn.
    """
    shown = [number for number in numbers if number <= spectrum.eigenvalues.shape[1]] or [1]
    vectors = spectrum.some_eigenvectors([number - 1 for number in shown])[0].numpy(force=True)
    figure, axes = _panels(vectors.shape[1:], len(shown), columns=math.ceil(math.sqrt(len(shown))), side=side)
    for axis, number, vector in zip(axes, shown, vectors, strict=True):
        title = f"Eigenvector {number}, eigenvalue {float(spectrum.eigenvalues[0, number - 1]):.4f}"
        _draw(axis, title, vector, limit=_limit(vector), colours="RdBu_r")
    return figure


def show_mask(image: Tensor, region: Tensor, mask: Tensor, *, side: int = PANEL_SIDE) -> Figure:
    """Draw a photograph with a region outlined, the region's mask, and the photograph faded outside the mask.

    Args:
        image: (1, C, H, W) in [0, 1].
        region: (1, 1, H, W), above 0.5 inside.
        mask: (1, 1, H, W) in [0, 1].
        side: Length in pixels of the longer side of each picture.
    """
    picture = _picture(image)
    weight = mask[0, 0].numpy(force=True)[..., None]
    figure, axes = _panels(picture.shape, 3, columns=3, side=side)
    _draw(axes[0], "The selected region", picture)
    axes[0].contour(region[0, 0].numpy(force=True), levels=[0.5], colors=["white"], linewidths=3)
    axes[0].contour(region[0, 0].numpy(force=True), levels=[0.5], colors=["black"], linewidths=1)
    _draw(axes[1], "Similarity to the region (white: similar)", weight[..., 0])
    faded = np.broadcast_to(0.6 + 0.25 * picture.mean(-1, keepdims=True), picture.shape)
    _draw(axes[2], "Pixels that the mask selects", weight * picture + (1 - weight) * faded)
    return figure


def plot_eigenvalues(spectrum: Spectrum) -> Figure:
    """Plot eigenvalues against their number; they fall faster for images with fewer patterns."""
    figure, axis = _plot()
    values = spectrum.eigenvalues[0].numpy(force=True)
    axis.plot(np.arange(1, len(values) + 1), values, marker="o", markersize=3)
    axis.set(xlabel="number", ylabel="eigenvalue λ", ylim=(-0.02, 1.05), title="Eigenvalues of the filter")
    return figure


def plot_response(alpha: Tensor, spectrum: Spectrum) -> Figure:
    """Plot the gain of the sliders, eq. (14), with the eigenvalues of the image marked on the curve."""
    figure, axis = _plot()
    line = torch.linspace(0, 1, 401, dtype=torch.float64)
    values = spectrum.eigenvalues[0].double().cpu()
    sliders = alpha.double().cpu()
    names = ", ".join(f"{value:g}" for value in alpha.tolist())
    axis.axhline(1, color="grey", linewidth=1, linestyle="--", label="untouched")
    axis.plot(line, polynomial_response(line, sliders), label=f"f(λ) for alpha = ({names})")
    axis.plot(values, polynomial_response(values, sliders), "o", markersize=4, label="eigenvalues of this image")
    xlabel = "eigenvalue λ (0: finest detail, 1: smooth shading)"
    axis.set(xlabel=xlabel, ylabel="gain f(λ)", title="Response of the sliders")
    axis.legend()
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG; the file appears complete or not at all."""
    with open_beside(path) as stream:
        # The usual compression takes as long as drawing, for files that are a fifth smaller.
        figure.savefig(stream, format="png", pil_kwargs={"compress_level": 2})


def _plot() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8, 5), dpi=DPI, layout="constrained")
    axis = figure.subplots()
    axis.grid(alpha=0.3)
    return figure, axis


def _picture(image: Tensor) -> NDArray[np.generic]:
    """Convert (1, C, H, W) or (C, H, W) to (H, W, 3) in [0, 1]."""
    channels = image.detach().reshape(-1, *image.shape[-2:]).clamp(0, 1)
    return channels.expand(3, -1, -1).permute(1, 2, 0).numpy(force=True)


def _limit(values: NDArray[np.generic]) -> float:
    """Compute the limit of a symmetric colour scale; positive even for a plane of zeros."""
    return max(float(np.quantile(np.abs(values), FAR)), 1e-6)


def _panels(
    shape: tuple[int, ...], count: int, columns: int | None, side: int, label: int = LABEL
) -> tuple[Figure, list[Axes]]:
    """Create a figure of ``count`` panels for pictures of that height and width, aligned to pixels."""
    across = min(columns or count, count)
    down = math.ceil(count / across)
    height, width = (round(length * side / max(shape[:2])) for length in shape[:2])
    full = (across * (width + GAP) + GAP, down * (height + label) + GAP)  # width, height in pixels
    figure = Figure(figsize=(full[0] / DPI, full[1] / DPI), dpi=DPI)
    axes = []
    for number in range(count):
        row, column = divmod(number, across)
        left, bottom = GAP + column * (width + GAP), full[1] - (row + 1) * (height + label)
        axes.append(figure.add_axes((left / full[0], bottom / full[1], width / full[0], height / full[1])))
    return figure, axes


def _draw(
    axis: Axes,
    title: str,
    picture: NDArray[np.generic],
    *,
    limit: float | None = None,
    colours: str = "gray",
    letters: int | None = None,
) -> None:
    """Draw a titled picture, with the colour scale ±limit if given and [0, 1] otherwise."""
    lowest, highest = (0.0, 1.0) if limit is None else (-limit, limit)
    axis.imshow(picture, cmap=colours, vmin=lowest, vmax=highest)
    fitting = min(11.0, max(6.0, axis.get_window_extent().width / 28))  # fits 36 letters
    axis.set_title(title, fontsize=fitting if letters is None else letters * POINTS / DPI)
    axis.set_axis_off()
