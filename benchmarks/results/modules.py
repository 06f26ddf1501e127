"""Calls of the modules of torch, with gradients in their parameters."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

import nlfilter_torch as nf
import nlfilter_torch.photo as nfp
from benchmarks.results.functions import Calls
from benchmarks.results.gradients import with_gradients
from benchmarks.results.inputs import box, image

ALPHA = (2.0, 0.5, 1.5, 1.0)
FEW: dict[str, Any] = {"num_landmarks": 40, "photometric_bandwidth": 0.2}


def calls(dtype: torch.dtype) -> Calls:
    """Calls on pictures of a dtype; a name and a colon begin their keys."""
    photo, guide = image("coffee", dtype), image("camera", dtype)
    built = nf.nonlocal_operator(guide, **FEW)
    return (
        of_filters(photo, guide, built, dtype)
        | of_masks(built.spectrum(), photo, dtype)
        | of_looks(photo, dtype)
        | of_denoisers(photo, dtype)
    )


def of_module(module: nn.Module, function: Callable[..., Any], *tensors: Tensor) -> list[Any]:
    """A module as text, its state, and values of a function with gradients in tensors and in parameters."""
    learned = [parameter for parameter in module.parameters() if parameter.requires_grad]
    return [repr(module), module.state_dict(), *with_gradients(function, *tensors, parameters=learned)]


def of_filters(photo: Tensor, guide: Tensor, built: nf.NonlocalOperator, dtype: torch.dtype) -> Calls:
    """Calls of filters, affinities and sliders."""
    affinity = nf.NonlocalAffinity(spatial_bandwidth=8.0, **FEW).to(dtype)
    names = ("photometric_bandwidth", "spatial_bandwidth", "patch_weights")
    learned = nf.NonlocalAffinity(spatial_bandwidth=8.0, learn=names, **FEW).to(dtype)
    whole = nf.NonlocalFilter(ALPHA, residual=0.5, learn=("alpha", "residual", "photometric_bandwidth"), **FEW).to(
        dtype
    )
    regions = nf.NonlocalFilter([ALPHA, ALPHA[::-1]], **FEW).to(dtype)
    sliders = nf.PolynomialSliders(ALPHA).to(dtype)
    masks = torch.cat([box(3, 4, dtype), box(12, 20, dtype, 9)], dim=1)
    portable = nf.Portable(nf.NonlocalFilter(ALPHA, landmarks="uniform", **FEW).to(dtype))

    def product(guide: Tensor) -> Tensor:
        return learned(guide) @ photo

    return {
        "NonlocalAffinity": lambda: [repr(affinity), affinity(guide), affinity(guide) @ photo],
        "NonlocalAffinity: learned": lambda: of_module(learned, product, guide),
        "NonlocalFilter": lambda: of_module(whole, whole, photo),
        "NonlocalFilter: guide": lambda: with_gradients(lambda image, guide: whole(image, guide), photo, guide),
        "NonlocalFilter: regions": lambda: of_module(regions, lambda image: regions(image, mask=masks), photo),
        "NonlocalFilter: sliders": lambda: with_gradients(
            lambda alpha: whole(photo, alpha=alpha), torch.tensor([ALPHA], dtype=dtype)
        ),
        "PolynomialSliders": lambda: of_module(sliders, lambda image: sliders(built, image), photo),
        "PolynomialSliders: layers": lambda: sliders.combine(nf.detail_layers(built, photo)),
        "Portable": lambda: [repr(portable), portable(photo)],
    }


def of_masks(spectrum: nf.Spectrum, photo: Tensor, dtype: torch.dtype) -> Calls:
    """Calls of masks."""
    region, others = box(3, 4, dtype), box(15, 22, dtype, 6)
    mask = nf.DiffusionMask(time=1.5, width=3.0, learn=("time", "width")).to(dtype)
    segments = nf.SegmentMask(time=2.0)
    refined = nf.Refine(kind="mask", classes=2, learn=("strength", "margin", "compatibility")).to(dtype)
    return {
        "DiffusionMask": lambda: of_module(mask, lambda region: mask(spectrum, region, others), region),
        "Refine": lambda: of_module(refined, lambda region: refined(region, photo, region), region),
        "SegmentMask": lambda: [repr(segments), segments(spectrum, torch.cat([region, others], dim=1))],
    }


def of_looks(photo: Tensor, dtype: torch.dtype) -> Calls:
    """Calls of looks."""
    start = {"alpha": torch.tensor(ALPHA), "local": torch.linspace(0, 0.3, 8), "stretch": torch.full((3,), 0.2)}
    look, plain = nfp.Look(start, num_landmarks=40).to(dtype), nfp.Look(learn=("curves",), knots=5).to(dtype)
    matrix = torch.eye(3, dtype=dtype)[[1, 0, 2]]
    return {
        "Look": lambda: of_module(look, look, photo),
        "Look: identity": lambda: of_module(plain, plain, photo),
        "Look: parts": lambda: with_gradients(lambda matrix: plain(photo, matrix=matrix), matrix),
    }


def of_denoisers(photo: Tensor, dtype: torch.dtype) -> Calls:
    """Calls of the denoiser."""
    trained = nf.NonlocalDenoiser.trained(dtype=dtype)
    noise = torch.tensor([0.05], dtype=dtype)
    levels = 0.02 + 0.1 * photo[:, :1]
    torch.manual_seed(0)
    new = nf.NonlocalDenoiser(passes=1).to(dtype)
    wide = torch.cat([photo] * 5, dim=3)  # in several tiles
    return {
        "NonlocalDenoiser": lambda: of_module(trained, trained, photo, noise),
        "NonlocalDenoiser: a new one": lambda: [new.state_dict(), new(photo, noise)],
        "NonlocalDenoiser: turns": lambda: trained(photo[:, :1], levels, turns=4),
        "NonlocalDenoiser: tiles": lambda: trained(wide, 0.1),
        "NonlocalDenoiser: without a batch": lambda: trained(photo[0], levels[0]),
    }
