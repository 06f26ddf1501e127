"""A global, data-adapted image filter as a differentiable object.

Talebi and Milanfar, "Nonlocal Image Editing", IEEE Transactions on Image Processing 23(10), 2014.
"""

from nlfilter_torch.bandwidth import estimate_bandwidth
from nlfilter_torch.filtering import captured_energy, detail_layers, polynomial_filter, spectral_filter
from nlfilter_torch.fitting import fit_alpha
from nlfilter_torch.masks import diffusion_map, diffusion_mask, segment_mask
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

__version__ = "0.1.0"

__all__ = [
    "Diagnostics",
    "DiffusionMask",
    "NonlocalAffinity",
    "NonlocalFilter",
    "NonlocalOperator",
    "PolynomialSliders",
    "SegmentMask",
    "Spectrum",
    "captured_energy",
    "detail_layers",
    "diffusion_map",
    "diffusion_mask",
    "estimate_bandwidth",
    "fit_alpha",
    "nonlocal_operator",
    "polynomial_filter",
    "polynomial_response",
    "segment_mask",
    "spectral_filter",
]
