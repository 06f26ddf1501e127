"""A global, data-adapted image filter as a differentiable object.

Talebi and Milanfar, "Nonlocal Image Editing", IEEE Transactions on Image Processing 23(10), 2014.

Public names are imported when they are first used, so that commands that need no filter do not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

# For type checkers, to which "name as name" says that a name is public.
if TYPE_CHECKING:
    from nlfilter_torch.edits.abstract import abstract as abstract
    from nlfilter_torch.edits.colorize import colorize as colorize
    from nlfilter_torch.edits.defocus import defocus as defocus
    from nlfilter_torch.edits.denoise import denoise as denoise
    from nlfilter_torch.edits.detail import enhance as enhance
    from nlfilter_torch.edits.fit_look import FittedLook as FittedLook
    from nlfilter_torch.edits.fit_look import fit_look as fit_look
    from nlfilter_torch.edits.frames import filter_frames as filter_frames
    from nlfilter_torch.edits.look import apply_look as apply_look
    from nlfilter_torch.edits.mask import region_mask as region_mask
    from nlfilter_torch.edits.noise import estimate_noise as estimate_noise
    from nlfilter_torch.edits.recolor import recolor as recolor
    from nlfilter_torch.edits.sharpen import sharpen as sharpen
    from nlfilter_torch.edits.tone import adjust_tone as adjust_tone
    from nlfilter_torch.filtering.filters import captured_energy as captured_energy
    from nlfilter_torch.filtering.filters import compose_alpha as compose_alpha
    from nlfilter_torch.filtering.filters import detail_layers as detail_layers
    from nlfilter_torch.filtering.filters import filter_regions as filter_regions
    from nlfilter_torch.filtering.filters import polynomial_filter as polynomial_filter
    from nlfilter_torch.filtering.filters import polynomial_response as polynomial_response
    from nlfilter_torch.filtering.filters import spectral_filter as spectral_filter
    from nlfilter_torch.filtering.fit import fit_alpha as fit_alpha
    from nlfilter_torch.filtering.fitted import FittedFilter as FittedFilter
    from nlfilter_torch.filtering.fitted import fit_filter as fit_filter
    from nlfilter_torch.filtering.masks import diffusion_map as diffusion_map
    from nlfilter_torch.filtering.masks import diffusion_mask as diffusion_mask
    from nlfilter_torch.filtering.masks import segment_mask as segment_mask
    from nlfilter_torch.filtering.scribbles import propagate_strokes as propagate_strokes
    from nlfilter_torch.nn import DiffusionMask as DiffusionMask
    from nlfilter_torch.nn import Look as Look
    from nlfilter_torch.nn import NonlocalAffinity as NonlocalAffinity
    from nlfilter_torch.nn import NonlocalDenoiser as NonlocalDenoiser
    from nlfilter_torch.nn import NonlocalFilter as NonlocalFilter
    from nlfilter_torch.nn import PolynomialSliders as PolynomialSliders
    from nlfilter_torch.nn import Portable as Portable
    from nlfilter_torch.nn import SegmentMask as SegmentMask
    from nlfilter_torch.operator.build import nonlocal_operator as nonlocal_operator
    from nlfilter_torch.operator.build import operator_from_features as operator_from_features
    from nlfilter_torch.operator.features import estimate_bandwidth as estimate_bandwidth
    from nlfilter_torch.operator.operator import Certificate as Certificate
    from nlfilter_torch.operator.operator import Diagnostics as Diagnostics
    from nlfilter_torch.operator.operator import NonlocalOperator as NonlocalOperator
    from nlfilter_torch.operator.spectrum import Spectrum as Spectrum

__version__ = "0.1.0"

#: The public names that each module defines.
_DEFINES: dict[str, tuple[str, ...]] = {
    "edits.abstract": ("abstract",),
    "edits.colorize": ("colorize",),
    "edits.defocus": ("defocus",),
    "edits.denoise": ("denoise",),
    "edits.detail": ("enhance",),
    "edits.fit_look": ("FittedLook", "fit_look"),
    "edits.frames": ("filter_frames",),
    "edits.look": ("apply_look",),
    "edits.mask": ("region_mask",),
    "edits.noise": ("estimate_noise",),
    "edits.recolor": ("recolor",),
    "edits.sharpen": ("sharpen",),
    "edits.tone": ("adjust_tone",),
    "filtering.filters": (
        "captured_energy",
        "compose_alpha",
        "detail_layers",
        "filter_regions",
        "polynomial_filter",
        "polynomial_response",
        "spectral_filter",
    ),
    "filtering.fit": ("fit_alpha",),
    "filtering.fitted": ("FittedFilter", "fit_filter"),
    "filtering.masks": ("diffusion_map", "diffusion_mask", "segment_mask"),
    "filtering.scribbles": ("propagate_strokes",),
    "nn": (
        "DiffusionMask",
        "Look",
        "NonlocalAffinity",
        "NonlocalDenoiser",
        "NonlocalFilter",
        "PolynomialSliders",
        "Portable",
        "SegmentMask",
    ),
    "operator.build": ("nonlocal_operator", "operator_from_features"),
    "operator.features": ("estimate_bandwidth",),
    "operator.operator": ("Certificate", "Diagnostics", "NonlocalOperator"),
    "operator.spectrum": ("Spectrum",),
}
_DEFINED_IN = {name: module for module, names in _DEFINES.items() for name in names}

__all__ = list(_DEFINED_IN)


def __getattr__(name: str) -> Any:
    if name not in _DEFINED_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_DEFINED_IN[name]}"), name)
    globals()[name] = value  # the next access takes it from here
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
