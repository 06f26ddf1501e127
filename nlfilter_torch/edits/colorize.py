"""A grey photograph and a few strokes of colour to a colour photograph. Paper: Sec. V-B, Fig. 16."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_count,
    check_image,
    check_patch_size,
    check_photograph,
    check_positive,
    check_same_size,
)
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.edits.colour import group_colours, merge_luminance, nearby, split_luminance
from nlfilter_torch.edits.parameters import COLORIZE
from nlfilter_torch.filtering.masks import segment_mask
from nlfilter_torch.filtering.scribbles import check_painted, propagate_strokes
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.spectrum import Spectrum

Method = Literal["regression", "kmeans"]


@dataclass(frozen=True)
class Stage:
    """One regression of several, each on what the ones before leave of the strokes' chroma.

    Attributes:
        spatial: bandwidth, as a multiple of that of the call.
        photometric: likewise.
        patch_size: of the patches, at most.
        reach: of :func:`propagate_strokes`.
        smoothness: likewise.
    """

    spatial: float
    photometric: float
    patch_size: float
    reach: float
    smoothness: float


# These, and the defaults of COLORIZE, were found on five photographs of 160x240 with 6 to 60 random strokes; all of it
# may be doubled or halved at a cost of less than 0.3 dB.
FAR, NEAR = Stage(1.0, 1.0, math.inf, 0.95, 2.0), Stage(2 / 9, 3.0, 3, 0.5, 2.0)


@full_precision
def colorize(
    grey: Tensor,
    strokes: Tensor,
    stroke_mask: Tensor,
    *,
    method: Method = COLORIZE.defaults["method"],
    strength: float | Tensor = COLORIZE.defaults["strength"],
    time: float | Tensor = 1.0,
    photometric_bandwidth: float | Tensor = COLORIZE.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = COLORIZE.defaults["patch_size"],
    num_landmarks: int = COLORIZE.defaults["num_landmarks"],
    generator: torch.Generator | None = None,
) -> Tensor:
    """Colour a grey image from strokes; its luminance stays as it is.

    Paper: Sec. V-B. ``"regression"`` extends the chroma of the strokes by :func:`propagate_strokes`, first far, then
    what is left of it near the strokes; ``"kmeans"`` is the paper's way: the image is cut into as many pieces as there
    are colours, by :func:`segment_mask`.

    Args:
        grey: (B, 1, H, W) in [0, 1].
        strokes: (B, 3, H, W), RGB; their chroma counts, their luminance does not.
        stroke_mask: (B, 1, H, W) in [0, 1], above 0 where painted. Grey paint keeps its likes grey.
        method: ``"regression"`` or ``"kmeans"``.
        strength: in [0, 1]: at 1 every pixel takes colour, at 0 what resembles no stroke stays grey. For the
            regression.
        time: diffusion time t > 0 of the pieces. For k-means.
        photometric_bandwidth: in units of the image; how much grey levels may differ under one colour.
        spatial_bandwidth: in pixels; None is 0.5625 of the short side.
        patch_size: of the patches that are compared.
        num_landmarks: M of the operator.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        RGB (B, 3, H, W) in [0, 1] where ``grey`` is; a colour too strong for its luminance is weakened. Differentiable
        in image, strokes, mask and bandwidths under ``"regression"``, in the strokes only under ``"kmeans"``.

    Raises:
        TypeError, ValueError: if a tensor has another size, the mask leaves [0, 1], or nothing is painted.

    Example:
        >>> grey = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0)) * 0.2 + 0.1
        >>> grey[..., 12:] += 0.6
        >>> strokes, painted = torch.zeros(1, 3, 24, 24), torch.zeros(1, 1, 24, 24)
        >>> strokes[:, 2, :4, :4], strokes[:, 0, :4, -4:] = 0.8, 0.8  # dark is blue, bright is red
        >>> painted[..., :4, :4] = painted[..., :4, -4:] = 1
        >>> colour = colorize(grey, strokes, painted, num_landmarks=50)
        >>> bool((colour[:, 2] > colour[:, 0])[..., :10].all()), bool((colour[:, 0] > colour[:, 2])[..., 14:].all())
        (True, True)
    """
    check_photograph(grey, "grey", channels=1)
    COLORIZE["method"].check_argument(method)
    check_positive(photometric_bandwidth, "photometric_bandwidth", grey.shape[0])
    if spatial_bandwidth is not None:
        check_positive(spatial_bandwidth, "spatial_bandwidth", grey.shape[0])
    check_patch_size(patch_size)
    check_count(num_landmarks, "num_landmarks")
    once = Colorization(
        grey,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        num_landmarks=num_landmarks,
        generator=generator,
        hold=False,
    )
    return once(strokes, stroke_mask, method=method, strength=strength, time=time)


class Colorization:
    """A grey image, held with the filters that find likes in it, so that more strokes need no other filters.

    Args:
        grey: of :func:`colorize`.
        hold: both filters; without, one at a time takes memory, and each call makes them anew.
        **options: of its filters; those left out are its defaults.
    """

    def __init__(self, grey: Tensor, *, hold: bool = True, **options: Any) -> None:
        self._grey = grey
        own = ("photometric_bandwidth", "patch_size", "num_landmarks")
        defaults = {name: COLORIZE.defaults[name] for name in own}
        options = {**defaults, **options}
        bandwidth = nearby(options.get("spatial_bandwidth"), COLORIZE["spatial_bandwidth"].share, grey.shape[-2:])
        options["num_landmarks"] = min(options["num_landmarks"], grey[0].numel())

        def spectrum(stage: Stage) -> Spectrum:
            scaled = {
                "patch_size": int(min(options["patch_size"], stage.patch_size)),
                "photometric_bandwidth": stage.photometric * options["photometric_bandwidth"],
                "spatial_bandwidth": stage.spatial * bandwidth,
            }
            return nonlocal_operator(grey.to(working_dtype(grey)), **(options | scaled)).spectrum()

        self._spectrum = cache(spectrum) if hold else spectrum

    @full_precision
    def __call__(
        self,
        strokes: Tensor,
        stroke_mask: Tensor,
        *,
        method: Method = COLORIZE.defaults["method"],
        strength: float | Tensor = COLORIZE.defaults["strength"],
        time: float | Tensor = 1.0,
    ) -> Tensor:
        """The image in colour, (B, 3, H, W); arguments and errors are those of :func:`colorize`."""
        grey = self._grey
        batch, size = grey.shape[0], (grey.shape[-2], grey.shape[-1])
        for tensor, name, channels in ((strokes, "strokes", 3), (stroke_mask, "stroke_mask", 1)):
            check_image(tensor, name, channels=channels, batch=batch)
            check_same_size(tensor, size, name, "grey image")
        check_painted(stroke_mask)
        COLORIZE["strength"].check_argument(strength, batch)
        check_positive(time, "time", batch)

        luminance = grey.to(working_dtype(grey))
        painted = stroke_mask.to(luminance).expand(batch, -1, -1, -1)
        wanted = split_luminance(strokes.to(luminance).expand(batch, -1, -1, -1))[1]
        if method == "kmeans":
            regions, colours, _ = group_colours(wanted, painted)
            pieces = segment_mask(self._spectrum(FAR), regions, time=time)
            chroma = torch.einsum("bkhw,bkc->bchw", pieces, colours)
        else:
            chroma = torch.zeros_like(wanted)
            for stage in (FAR, NEAR):
                part = strength if stage is FAR else 0.0
                given = {"strength": part, "reach": stage.reach, "smoothness": stage.smoothness}
                chroma = chroma + propagate_strokes(self._spectrum(stage), wanted - chroma, painted, **given)
        return merge_luminance(luminance, chroma).to(grey.dtype)
