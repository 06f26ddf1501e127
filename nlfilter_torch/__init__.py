"""A global, data-adapted image filter as a differentiable object.

Talebi and Milanfar, "Nonlocal Image Editing", IEEE Transactions on Image Processing 23(10), 2014.
"""

from nlfilter_torch.bandwidth import estimate_bandwidth
from nlfilter_torch.edits.abstract import abstract
from nlfilter_torch.edits.colorize import colorize
from nlfilter_torch.edits.defocus import defocus
from nlfilter_torch.edits.denoise import denoise, estimate_noise
from nlfilter_torch.edits.enhance import enhance
from nlfilter_torch.edits.recolor import recolor
from nlfilter_torch.edits.sharpen import sharpen
from nlfilter_torch.edits.tone import adjust_tone
from nlfilter_torch.filtering import captured_energy, detail_layers, polynomial_filter, spectral_filter
from nlfilter_torch.fitting import fit_alpha
from nlfilter_torch.frames import FittedFilter, filter_frames, fit_filter
from nlfilter_torch.masks import compose_alpha, diffusion_map, diffusion_mask, filter_regions, segment_mask
from nlfilter_torch.modules import (
    DiffusionMask,
    NonlocalAffinity,
    NonlocalFilter,
    PolynomialSliders,
    SegmentMask,
)
from nlfilter_torch.operator import Diagnostics, NonlocalOperator, nonlocal_operator
from nlfilter_torch.response import polynomial_response
from nlfilter_torch.spectrum import Spectrum
from nlfilter_torch.strokes import propagate_strokes

__version__ = "0.1.0"

__all__ = [
    "Diagnostics",
    "DiffusionMask",
    "FittedFilter",
    "NonlocalAffinity",
    "NonlocalFilter",
    "NonlocalOperator",
    "PolynomialSliders",
    "SegmentMask",
    "Spectrum",
    "abstract",
    "adjust_tone",
    "captured_energy",
    "colorize",
    "compose_alpha",
    "defocus",
    "denoise",
    "detail_layers",
    "diffusion_map",
    "diffusion_mask",
    "enhance",
    "estimate_bandwidth",
    "estimate_noise",
    "filter_frames",
    "filter_regions",
    "fit_alpha",
    "fit_filter",
    "nonlocal_operator",
    "polynomial_filter",
    "polynomial_response",
    "propagate_strokes",
    "recolor",
    "segment_mask",
    "sharpen",
    "spectral_filter",
]
