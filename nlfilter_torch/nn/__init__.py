"""The functions of this package as ``torch.nn`` layers, which hold parameters but no mathematics."""

from nlfilter_torch.nn.affinity import NonlocalAffinity
from nlfilter_torch.nn.block import NonlocalBlock
from nlfilter_torch.nn.denoiser.network import NonlocalDenoiser
from nlfilter_torch.nn.masks import DiffusionMask, SegmentMask
from nlfilter_torch.nn.portable import Portable
from nlfilter_torch.nn.refine import Refine
from nlfilter_torch.nn.sliders import NonlocalFilter, PolynomialSliders

__all__ = [
    "DiffusionMask",
    "NonlocalAffinity",
    "NonlocalBlock",
    "NonlocalDenoiser",
    "NonlocalFilter",
    "PolynomialSliders",
    "Portable",
    "Refine",
    "SegmentMask",
]
