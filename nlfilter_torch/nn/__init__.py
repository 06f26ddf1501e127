"""The functions of this package as ``torch.nn`` layers, which hold parameters but no mathematics."""

from nlfilter_torch.nn.affinity import NonlocalAffinity
from nlfilter_torch.nn.denoiser import NonlocalDenoiser
from nlfilter_torch.nn.look import Look
from nlfilter_torch.nn.masks import DiffusionMask, SegmentMask
from nlfilter_torch.nn.portable import Portable
from nlfilter_torch.nn.sliders import NonlocalFilter, PolynomialSliders

__all__ = [
    "DiffusionMask",
    "Look",
    "NonlocalAffinity",
    "NonlocalDenoiser",
    "NonlocalFilter",
    "PolynomialSliders",
    "Portable",
    "SegmentMask",
]
