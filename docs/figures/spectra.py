"""Figs. 1 and 3: eigenvectors of the filter, with and without the spatial term."""

import matplotlib
import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.photographs import SIZE, luminance, scene
from docs.scenes import SIDE, Numbers, rounded
from nlfilter_torch import Spectrum, nonlocal_operator
from nlfilter_torch.photo.plotting import show_images

SHOWN = (2, 3, 10, 25, 50)
LANDMARKS = 100
NEAR, NARROW = 20.0, 5 / 255  # h_x in pixels and h_y of Fig. 3


def figure_1(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Leading eigenvectors from luminance alone, 100 landmarks. The first contain the main edges, later ones texture.

    The paper samples 0.01 % of the pixels of a larger photograph. Red is positive, blue negative.
    """
    image = scene("camera", size)[0]
    operator = nonlocal_operator(luminance(image), num_landmarks=LANDMARKS)
    return _draw(image, operator.spectrum())


def figure_3(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Eigenvectors with a narrow spatial term (h_x = 20 pixels, h_y = 5 grey levels): piecewise smooth, local patterns.

    400 landmarks, as there are many local patterns. h_y is multiplied by 4.2 to account for the paper's patch weights.
    """
    image = scene("camera", size)[0]
    operator = nonlocal_operator(
        luminance(image), num_landmarks=4 * LANDMARKS, photometric_bandwidth=4.2 * NARROW, spatial_bandwidth=NEAR
    )
    return _draw(image, operator.spectrum())


def _draw(image: Tensor, spectrum: Spectrum) -> tuple[Figure, Numbers]:
    values = spectrum.eigenvalues[0]
    letters = "bcdefgh"
    panels = {"(a) photograph": image}
    for letter, number in zip(letters, SHOWN, strict=False):
        vector = spectrum.eigenvectors[0, number - 1]
        panels[f"({letter}) v{number}, eigenvalue {values[number - 1]:.4f}"] = coloured(vector)
    pixels = image.shape[-2] * image.shape[-1]
    numbers: Numbers = {f"eigenvalue {number}": rounded(values[number - 1]) for number in SHOWN}
    numbers["landmarks, % of pixels"] = rounded(100 * spectrum.factor.shape[1] / pixels, 3)
    return show_images(panels, columns=3, side=SIDE), numbers


def coloured(values: Tensor) -> Tensor:
    """Map signed values (H, W) to colours (1, 3, H, W), from blue through white to red."""
    reach = values.abs().flatten().quantile(0.995).clamp(min=1e-6)
    shades = matplotlib.colormaps["RdBu_r"](((values / reach + 1) / 2).clamp(0, 1).numpy())
    return torch.from_numpy(shades[..., :3]).permute(2, 0, 1)[None].float()
