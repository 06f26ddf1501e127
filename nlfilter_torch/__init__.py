"""A global, data-adapted image filter as a differentiable object.

Talebi and Milanfar, "Nonlocal Image Editing", IEEE Transactions on Image Processing 23(10), 2014.

Public names are imported when they are first used, so that commands that need no filter do not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

# For type checkers, to which "name as name" says that a name is public.
if TYPE_CHECKING:
    from nlfilter_torch.bandwidth import estimate_bandwidth as estimate_bandwidth
    from nlfilter_torch.edits.abstract import abstract as abstract
    from nlfilter_torch.edits.colorize import colorize as colorize
    from nlfilter_torch.edits.defocus import defocus as defocus
    from nlfilter_torch.edits.denoise import denoise as denoise
    from nlfilter_torch.edits.denoise import estimate_noise as estimate_noise
    from nlfilter_torch.edits.enhance import enhance as enhance
    from nlfilter_torch.edits.recolor import recolor as recolor
    from nlfilter_torch.edits.sharpen import sharpen as sharpen
    from nlfilter_torch.edits.tone import adjust_tone as adjust_tone
    from nlfilter_torch.filtering import captured_energy as captured_energy
    from nlfilter_torch.filtering import detail_layers as detail_layers
    from nlfilter_torch.filtering import polynomial_filter as polynomial_filter
    from nlfilter_torch.filtering import spectral_filter as spectral_filter
    from nlfilter_torch.fitting import fit_alpha as fit_alpha
    from nlfilter_torch.frames import FittedFilter as FittedFilter
    from nlfilter_torch.frames import filter_frames as filter_frames
    from nlfilter_torch.frames import fit_filter as fit_filter
    from nlfilter_torch.masks import compose_alpha as compose_alpha
    from nlfilter_torch.masks import diffusion_map as diffusion_map
    from nlfilter_torch.masks import diffusion_mask as diffusion_mask
    from nlfilter_torch.masks import filter_regions as filter_regions
    from nlfilter_torch.masks import segment_mask as segment_mask
    from nlfilter_torch.modules import DiffusionMask as DiffusionMask
    from nlfilter_torch.modules import NonlocalAffinity as NonlocalAffinity
    from nlfilter_torch.modules import NonlocalFilter as NonlocalFilter
    from nlfilter_torch.modules import PolynomialSliders as PolynomialSliders
    from nlfilter_torch.modules import SegmentMask as SegmentMask
    from nlfilter_torch.operator import Certificate as Certificate
    from nlfilter_torch.operator import Diagnostics as Diagnostics
    from nlfilter_torch.operator import NonlocalOperator as NonlocalOperator
    from nlfilter_torch.operator import nonlocal_operator as nonlocal_operator
    from nlfilter_torch.response import polynomial_response as polynomial_response
    from nlfilter_torch.spectrum import Spectrum as Spectrum
    from nlfilter_torch.strokes import propagate_strokes as propagate_strokes

__version__ = "0.1.0"

#: Every public name, and the module that defines it.
_DEFINED_IN = {
    "Certificate": "operator",
    "Diagnostics": "operator",
    "DiffusionMask": "modules",
    "FittedFilter": "frames",
    "NonlocalAffinity": "modules",
    "NonlocalFilter": "modules",
    "NonlocalOperator": "operator",
    "PolynomialSliders": "modules",
    "SegmentMask": "modules",
    "Spectrum": "spectrum",
    "abstract": "edits.abstract",
    "adjust_tone": "edits.tone",
    "captured_energy": "filtering",
    "colorize": "edits.colorize",
    "compose_alpha": "masks",
    "defocus": "edits.defocus",
    "denoise": "edits.denoise",
    "detail_layers": "filtering",
    "diffusion_map": "masks",
    "diffusion_mask": "masks",
    "enhance": "edits.enhance",
    "estimate_bandwidth": "bandwidth",
    "estimate_noise": "edits.denoise",
    "filter_frames": "frames",
    "filter_regions": "masks",
    "fit_alpha": "fitting",
    "fit_filter": "frames",
    "nonlocal_operator": "operator",
    "polynomial_filter": "filtering",
    "polynomial_response": "response",
    "propagate_strokes": "strokes",
    "recolor": "edits.recolor",
    "segment_mask": "masks",
    "sharpen": "edits.sharpen",
    "spectral_filter": "filtering",
}

__all__ = list(_DEFINED_IN)


def __getattr__(name: str) -> Any:
    if name not in _DEFINED_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_DEFINED_IN[name]}"), name)
    globals()[name] = value  # the next access takes it from here
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
