"""The functions of this package as ``torch.nn`` layers: parameters here, mathematics there."""

from nlfilter_torch.modules.affinity import NonlocalAffinity
from nlfilter_torch.modules.filter import NonlocalFilter
from nlfilter_torch.modules.masks import DiffusionMask, SegmentMask
from nlfilter_torch.modules.sliders import PolynomialSliders

__all__ = ["DiffusionMask", "NonlocalAffinity", "NonlocalFilter", "PolynomialSliders", "SegmentMask"]
