"""Calls of the functions and objects of the filter."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

import nlfilter_torch as nf
from benchmarks.results.gradients import with_gradients
from benchmarks.results.inputs import box, image, seeded

Calls = dict[str, Callable[[], Any]]

FEW: dict[str, Any] = {"num_landmarks": 40, "photometric_bandwidth": 0.2}
OPTIONS: dict[str, dict[str, Any]] = {
    "by default": {},
    "uniform": {"landmarks": "uniform", "num_landmarks": 30},
    "random": {"landmarks": "random", "num_landmarks": 30, "generator": 5},
    "without completion": {"completion": "none", "photometric_bandwidth": 0.6, "num_landmarks": 50},
    "distances": {"spatial_bandwidth": (6.0, 9.0), "patch_size": 3, "num_landmarks": 60},
    "distance": {"spatial_bandwidth": 8.0, "patch_size": 7, "tolerance": 1e-6},
    "all channels": {"guide_channels": "all", "patch_size": 1, "photometric_bandwidth": 0.1},
    "too many landmarks": {"num_landmarks": 5000, "patch_size": 1},
}


def calls(dtype: torch.dtype) -> Calls:
    """Calls on pictures of a dtype; a name and a colon begin their keys."""
    guide, colours = image("camera", dtype), image("coffee", dtype)
    built = nf.nonlocal_operator(guide, **FEW)
    return (
        of_operators(colours, dtype)
        | of_methods(built, guide, colours)
        | of_filters(built, colours, dtype)
        | of_fits(built, guide, colours, dtype)
        | of_masks(built.spectrum(), dtype)
    )


def summary(operator: nf.NonlocalOperator) -> list[Any]:
    """An operator, with a product and its row sums."""
    return [operator, operator @ torch.ones_like(operator.diagonal_share), operator.row_sums()]


def of_options(guide: Tensor, options: dict[str, Any]) -> list[Any]:
    """An operator built with options, of which the generator is given by its seed."""
    seeds = {name: seeded(seed) for name, seed in options.items() if name == "generator"}
    return summary(nf.nonlocal_operator(guide, **options | seeds))


def of_operators(colours: Tensor, dtype: torch.dtype) -> Calls:
    """Calls that build operators, with gradients in all that may have one."""

    def filtered(guide: Tensor, photometric: Tensor, spatial: Tensor, weights: Tensor) -> Tensor:
        bandwidths: dict[str, Any] = {"photometric_bandwidth": photometric, "spatial_bandwidth": spatial}
        return nf.nonlocal_operator(guide, num_landmarks=30, patch_weights=weights, **bandwidths) @ colours

    def of_features(features: Tensor) -> nf.NonlocalOperator:
        return nf.operator_from_features(features, size=(24, 32), num_landmarks=30)

    bandwidths = torch.tensor(0.3, dtype=dtype), torch.tensor(9.0, dtype=dtype)
    window = torch.tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]], dtype=dtype)
    features = torch.cat([3 * colours, image("astronaut", dtype)], dim=1).flatten(2) * 4
    weights = 1 + torch.arange(768, dtype=dtype).remainder(3)[None]
    pair = torch.cat([colours, image("astronaut", dtype)])
    named: Calls = {
        f"nonlocal_operator: {name}": partial(of_options, colours, values) for name, values in OPTIONS.items()
    }
    return named | {
        "nonlocal_operator: two images": lambda: summary(nf.nonlocal_operator(pair, **FEW)),
        "nonlocal_operator: flat": lambda: summary(nf.nonlocal_operator(torch.full_like(colours, 0.5), **FEW)),
        "nonlocal_operator: a row": lambda: summary(nf.nonlocal_operator(colours[..., :1, :], num_landmarks=20)),
        "nonlocal_operator: gradients": lambda: with_gradients(filtered, colours, *bandwidths, window),
        "operator_from_features": lambda: summary(of_features(features)),
        "NonlocalOperator: at": lambda: of_features(features).at(features[..., ::50] + 0.01),
        "operator_from_features: weights": lambda: nf.operator_from_features(
            features, size=(768,), weights=weights, num_landmarks=40, landmarks="random", generator=seeded(2)
        ),
        "operator_from_features: gradients": lambda: with_gradients(
            lambda features: of_features(features) @ colours, features
        ),
        "estimate_bandwidth": lambda: nf.estimate_bandwidth(pair),
        "estimate_bandwidth: all channels": lambda: nf.estimate_bandwidth(pair, guide_channels="all"),
    }


def of_methods(built: nf.NonlocalOperator, guide: Tensor, colours: Tensor) -> Calls:
    """Calls of the methods of operators and spectra, and what they return."""
    spectrum = built.spectrum()
    other = torch.float64 if guide.dtype == torch.float32 else torch.float32

    def synthesized(picture: Tensor) -> Tensor:
        return spectrum.synthesize(torch.sqrt, spectrum.coefficients(picture))

    def eigenvectors(picture: Tensor) -> Tensor:
        return nf.nonlocal_operator(picture, **FEW).spectrum(6).eigenvectors.square()

    return {
        "NonlocalOperator: products": lambda: with_gradients(built.matmul, colours),
        "NonlocalOperator: powers": lambda: with_gradients(lambda picture: built.powers(picture, 3), colours),
        "NonlocalOperator: parts": lambda: [built.to_dense(), built.diagonal_share, built.to(other)],
        "Certificate": built.certify,
        "Diagnostics": built.diagnostics,
        "Spectrum": lambda: [spectrum, spectrum.eigenvectors, spectrum.pixels, spectrum.mass],
        "Spectrum: rank": lambda: [built.spectrum(5), built.spectrum(5).eigenvectors],
        "Spectrum: to": lambda: spectrum.to(other),
        "Spectrum: synthesis": lambda: with_gradients(synthesized, colours),
        "Spectrum: gain": lambda: spectrum.gain(torch.sqrt),
        "Spectrum: gradients": lambda: with_gradients(eigenvectors, guide),
        "captured_energy": lambda: with_gradients(lambda picture: nf.captured_energy(spectrum, picture), colours),
    }


def of_filters(built: nf.NonlocalOperator, colours: Tensor, dtype: torch.dtype) -> Calls:
    """Calls of the filters, with sliders of all shapes."""
    spectrum = built.spectrum()
    alpha = torch.tensor([2.0, 0.5, 1.5, 1.0], dtype=dtype)
    masks = torch.cat([box(3, 4, dtype), box(12, 20, dtype, 9)], dim=1)
    maps = alpha.view(1, -1, 1, 1) + 0.3 * box(3, 4, dtype)
    rows = torch.stack([alpha, 2 - alpha])

    def response(values: Tensor) -> Tensor:
        return (1 + values).log()

    def regions(masks: Tensor, sliders: Tensor) -> Tensor:
        return nf.filter_regions(built, colours, masks, sliders, residual=0.5)

    def polynomial(picture: Tensor, sliders: Tensor) -> Tensor:
        return nf.polynomial_filter(built, picture, sliders)

    return {
        "compose_alpha": lambda: with_gradients(nf.compose_alpha, masks, rows[None]),
        "detail_layers": lambda: with_gradients(lambda picture: nf.detail_layers(built, picture), colours),
        "detail_layers: order": lambda: nf.detail_layers(built, colours, order=5),
        "filter_regions": lambda: with_gradients(regions, masks, rows),
        "polynomial_filter": lambda: with_gradients(polynomial, colours, alpha),
        "polynomial_filter: batch": lambda: with_gradients(polynomial, colours.expand(2, -1, -1, -1), rows),
        "polynomial_filter: maps": lambda: with_gradients(polynomial, colours, maps),
        "polynomial_filter: residual": lambda: nf.polynomial_filter(built, colours, alpha, residual=0.3),
        "polynomial_filter: halves": lambda: polynomial(colours.half(), alpha),
        "polynomial_response": lambda: with_gradients(nf.polynomial_response, spectrum.eigenvalues, alpha),
        "spectral_filter": lambda: with_gradients(lambda y: nf.spectral_filter(spectrum, y, response), colours),
        "spectral_filter: residual": lambda: nf.spectral_filter(
            spectrum, colours, response, residual=0.4, coefficients=spectrum.coefficients(colours)
        ),
    }


def of_fits(built: nf.NonlocalOperator, guide: Tensor, colours: Tensor, dtype: torch.dtype) -> Calls:
    """Calls that fit sliders to edits, and filters to pictures."""
    alpha = torch.tensor([2.0, 0.5, 1.5, 1.0], dtype=dtype)
    target = nf.polynomial_filter(built, colours, alpha) + 0.02 * colours.square()
    other, mask = image("astronaut", dtype)[:, 1:2], box(3, 4, dtype, 15)

    def absolute(edited: Tensor, wanted: Tensor) -> Tensor:
        return (edited - wanted).abs().flatten(1).mean(1)

    def fitted(picture: Tensor, sliders: Tensor) -> Tensor:
        return nf.fit_filter(built, guide)(picture, sliders, residual=0.5)

    return {
        "fit_alpha": lambda: with_gradients(lambda wanted: nf.fit_alpha(built, colours, wanted), target),
        "fit_alpha: options": lambda: nf.fit_alpha(built, colours, target, order=2, mask=mask, ridge=0.1),
        "fit_alpha: rounding": lambda: nf.fit_alpha(built, colours, target, rounding=1 / 255, shared=True),
        "fit_alpha: loss": lambda: nf.fit_alpha(built, colours, target, loss=absolute),
        "fit_filter": lambda: nf.fit_filter(built, colours, order=2),
        "FittedFilter": lambda: with_gradients(fitted, other, alpha),
        "FittedFilter: layers": lambda: nf.fit_filter(built, colours).layers(colours, other),
        "FittedFilter: a part": lambda: nf.fit_filter(built, guide).layers(
            other[..., 4:20, :], origin=(4, 0), halo=(2, 2)
        ),
        "FittedFilter: to": lambda: nf.fit_filter(built, guide).to(torch.float64).layers(other.double()),
    }


def of_masks(spectrum: nf.Spectrum, dtype: torch.dtype) -> Calls:
    """Calls that compute masks, and values from scribbles."""
    region, others = box(3, 4, dtype), box(15, 22, dtype, 6)
    both = torch.cat([region, others], dim=1)
    strokes = both.sum(1, keepdim=True) * image("astronaut", dtype)
    time, width = torch.tensor(1.5, dtype=dtype), torch.tensor(3.0, dtype=dtype)

    def mask(region: Tensor, time: Tensor, width: Tensor) -> Tensor:
        return nf.diffusion_mask(spectrum, region, time=time, width=width, negative=others)

    def spread(strokes: Tensor, painted: Tensor) -> Tensor:
        return nf.propagate_strokes(spectrum, strokes, painted)

    return {
        "diffusion_map": lambda: with_gradients(lambda time: nf.diffusion_map(spectrum, time=time), time),
        "diffusion_mask": lambda: nf.diffusion_mask(spectrum, both),
        "diffusion_mask: gradients": lambda: with_gradients(mask, region, time, width),
        "segment_mask": lambda: nf.segment_mask(spectrum, both, time=2.0),
        "refine": lambda: nf.refine(8 * both, image("astronaut", dtype), num_landmarks=40),
        "refine: trimap": lambda: nf.refine(region + others / 2, image("astronaut", dtype), kind="trimap"),
        "propagate_strokes": lambda: with_gradients(spread, strokes, both.sum(1, keepdim=True)),
        "propagate_strokes: options": lambda: nf.propagate_strokes(
            spectrum, strokes, both.sum(1, keepdim=True), strength=0.6, reach=0.7, smoothness=0.4
        ),
    }
