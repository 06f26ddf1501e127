"""Calls with wrong inputs, which must be refused with the same error."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import nlfilter_torch as nf
import nlfilter_torch.photo as nfp
from benchmarks.results.functions import Calls
from benchmarks.results.photographs import public

NAN, INFINITY = float("nan"), float("inf")
FEW: dict[str, Any] = {"num_landmarks": 20, "photometric_bandwidth": 0.3}
IMAGE = torch.rand(2, 3, 8, 9, generator=torch.Generator().manual_seed(0))
GREY, SINGLE = IMAGE[:, :1], IMAGE[:1, :1]
PAINTED = torch.zeros(2, 1, 8, 9).index_fill(3, torch.tensor([2]), 1.0)
EMPTY, ONES = torch.zeros(2, 1, 8, 9), torch.ones(4)
BUILT = nf.nonlocal_operator(GREY, **FEW)
SPECTRUM = BUILT.spectrum()
FITTED = nf.fit_filter(nf.nonlocal_operator(SINGLE, **FEW), SINGLE)

IMAGES: dict[str, Any] = {
    "array": np.zeros((2, 1, 8, 9)),
    "none": None,
    "integers": EMPTY.to(torch.uint8),
    "complex": EMPTY.to(torch.complex64),
    "three axes": EMPTY[0],
    "no row": EMPTY[:, :, :0],
    "no channel": EMPTY[:, :0],
    "NaN": EMPTY + NAN,
    "an infinity": PAINTED.where(PAINTED == 0, INFINITY),
    "another size": torch.zeros(2, 1, 9, 8),
    "three images": torch.zeros(3, 1, 8, 9),
    "another device": EMPTY.to("meta"),
}
OF_IMAGES: dict[str, Callable[[Any], object]] = {
    "nonlocal_operator": lambda x: nf.nonlocal_operator(x, **FEW),
    "estimate_bandwidth": nf.estimate_bandwidth,
    "estimate_noise": nf.estimate_noise,
    "noise_profile": nf.noise_profile,
    "matmul": lambda x: BUILT @ x,
    "detail_layers": lambda x: nf.detail_layers(BUILT, x),
    "polynomial_filter": lambda x: nf.polynomial_filter(BUILT, x, ONES),
    "spectral_filter": lambda x: nf.spectral_filter(SPECTRUM, x, torch.sqrt),
    "spectral_filter of the operator": lambda x: nf.spectral_filter(BUILT, x, torch.sqrt),
    "captured_energy": lambda x: nf.captured_energy(SPECTRUM, x),
    "fit_alpha": lambda x: nf.fit_alpha(BUILT, IMAGE, x),
    "fit_filter": lambda x: nf.fit_filter(BUILT, x),
    "diffusion_mask": lambda x: nf.diffusion_mask(SPECTRUM, x),
    "segment_mask": lambda x: nf.segment_mask(SPECTRUM, x),
    "refine": lambda x: nf.refine(x, BUILT),
    "propagate_strokes": lambda x: nf.propagate_strokes(SPECTRUM, IMAGE, x),
    "filter_regions": lambda x: nf.filter_regions(BUILT, IMAGE, x, ONES[None]),
    "enhance": lambda x: nfp.enhance(x, ONES, **FEW),
    "enhance with regions": lambda x: nfp.enhance(IMAGE, ONES, x, **FEW),
    "denoise": nfp.denoise,
    "recolor": lambda x: nfp.recolor(IMAGE, x, PAINTED),
    "colorize": lambda x: nfp.colorize(GREY, IMAGE, x),
    "defocus": lambda x: nfp.defocus(IMAGE, x),
    "region_mask": lambda x: nfp.region_mask(IMAGE, PAINTED, x),
    "apply_look": nfp.apply_look,
    "fit_look": lambda x: nfp.fit_look([(GREY, x)]),
    "filter_frames": lambda x: list(nfp.filter_frames([x], ONES, references=[SINGLE])),
    "NonlocalFilter": lambda x: nf.NonlocalFilter(num_landmarks=20)(IMAGE, guide=x),
    "NonlocalDenoiser": lambda x: nf.NonlocalDenoiser()(IMAGE, x),
    "Look": lambda x: nfp.Look()(x),
}
NUMBERS: dict[str, Any] = {
    "NaN": NAN,
    "an infinity": INFINITY,
    "negative": -1.0,
    "a text": "much",
    "a truth": True,
    "a list": [1.0, 2.0],
    "another batch": torch.full((3,), 0.5),
    "another shape": torch.full((2, 1), 0.5),
}
OF_NUMBERS: dict[str, Callable[[Any], object]] = {
    "patch_size": lambda v: nf.nonlocal_operator(GREY, patch_size=v),
    "photometric_bandwidth": lambda v: nf.nonlocal_operator(GREY, photometric_bandwidth=v),
    "spatial_bandwidth": lambda v: nf.nonlocal_operator(GREY, spatial_bandwidth=v),
    "num_landmarks": lambda v: nf.nonlocal_operator(GREY, num_landmarks=v),
    "landmarks": lambda v: nf.nonlocal_operator(GREY, landmarks=v),
    "tolerance": lambda v: nf.nonlocal_operator(GREY, tolerance=v),
    "patch_weights": lambda v: nf.nonlocal_operator(GREY, patch_weights=v),
    "generator": lambda v: nf.nonlocal_operator(GREY, generator=v),
    "rank": BUILT.spectrum,
    "residual": lambda v: nf.polynomial_filter(BUILT, IMAGE, ONES, residual=v),
    "order": lambda v: nf.detail_layers(BUILT, IMAGE, order=v),
    "time": lambda v: nf.diffusion_map(SPECTRUM, time=v),
    "width": lambda v: nf.diffusion_mask(SPECTRUM, PAINTED, width=v),
    "smoothness": lambda v: nf.propagate_strokes(SPECTRUM, IMAGE, PAINTED, smoothness=v),
    "ridge": lambda v: nf.fit_alpha(BUILT, IMAGE, IMAGE, ridge=v),
    "amount": lambda v: nfp.sharpen(IMAGE, amount=v, **FEW),
    "guide_blur": lambda v: nfp.sharpen(IMAGE, guide_blur=v, **FEW),
    "contrast": lambda v: nfp.adjust_tone(IMAGE, contrast=v, **FEW),
    "limits": lambda v: nfp.adjust_tone(IMAGE, limits=v, **FEW),
    "noise_level": lambda v: nfp.denoise(IMAGE, noise_level=v),
    "strength": lambda v: nfp.denoise(IMAGE, strength=v),
    "threshold": lambda v: nfp.enhance(IMAGE, ONES, threshold=v, **FEW),
    "viewing_size": lambda v: nfp.enhance(IMAGE, ONES, viewing_size=v, **FEW),
    "reach": lambda v: nfp.recolor(IMAGE, IMAGE, PAINTED, reach=v),
    "radius": lambda v: nfp.defocus(IMAGE, PAINTED, radius=v),
    "aperture": lambda v: nfp.defocus(IMAGE, PAINTED, aperture=v),
    "power": lambda v: nfp.abstract(IMAGE, power=v, **FEW),
    "edges": lambda v: nfp.abstract(IMAGE, edges=v, **FEW),
    "tones": lambda v: nfp.abstract(IMAGE, tones=v, **FEW),
    "method": lambda v: nfp.colorize(GREY, IMAGE, PAINTED, method=v),
    "noise": lambda v: nf.NonlocalDenoiser()(IMAGE, v),
    "passes": lambda v: nf.NonlocalDenoiser(v),
    "knots": lambda v: nfp.Look(knots=v),
    "time of a module": lambda v: nf.DiffusionMask(time=v),
    "bandwidth of a module": lambda v: nf.NonlocalAffinity(photometric_bandwidth=v),
}
SLIDERS: dict[str, Any] = {
    "a list": [1.0, 1.0],
    "integers": torch.tensor([1, 1]),
    "a single slider": torch.ones(1),
    "a number": torch.tensor(1.0),
    "another batch": torch.ones(3, 4),
    "another size": torch.ones(2, 4, 9, 8),
    "NaN": torch.tensor([1.0, NAN]),
}
OF_SLIDERS: dict[str, Callable[[Any], object]] = {
    "polynomial_filter": lambda v: nf.polynomial_filter(BUILT, IMAGE, v),
    "polynomial_response": lambda v: nf.polynomial_response(torch.ones(2, 3), v),
    "compose_alpha": lambda v: nf.compose_alpha(PAINTED, v),
    "enhance": lambda v: nfp.enhance(IMAGE, v, **FEW),
    "outside": lambda v: nfp.enhance(IMAGE, ONES, PAINTED, outside=v, **FEW),
    "apply_look": lambda v: nfp.apply_look(IMAGE, alpha=v),
    "NonlocalFilter": lambda v: nf.NonlocalFilter(v),
    "fitted": lambda v: FITTED(SINGLE, v),
}


def calls() -> Calls:
    """All calls, by what is called and what is wrong."""
    tables = {"image": (OF_IMAGES, IMAGES), "number": (OF_NUMBERS, NUMBERS), "sliders": (OF_SLIDERS, SLIDERS)}
    crossed = {
        f"{name} of {kind} as {argument}": partial(call, value)
        for argument, (functions, values) in tables.items()
        for name, call in functions.items()
        for kind, value in values.items()
    }
    return crossed | of_arguments() | of_objects() | of_edits() | of_application()


def of_arguments() -> Calls:
    """Calls without arguments, and with unknown ones."""
    public = {name: getattr(package, name) for package in (nf, nfp) for name in sorted(package.__all__)}
    functions = {name: value for name, value in public.items() if not name[0].isupper()}
    missing: Calls = {f"{name}()": function for name, function in functions.items()}
    unknown: Calls = {
        f"{name} of an unknown argument": partial(function, IMAGE, colour=1) for name, function in functions.items()
    }
    classes = {name: value for name, value in public.items() if isinstance(value, type)}
    learned: Calls = {
        f"{name} that learns an unknown option": partial(module, learn=("colour",))
        for name, module in classes.items()
        if issubclass(module, nn.Module)
    }
    return missing | unknown | learned | {"unknown name": lambda: nf.embellish}


def of_objects() -> Calls:
    """Calls with values of a wrong type in place of operators, spectra and functions."""

    def response(gain: Any) -> Callable[[], object]:
        return lambda: nf.spectral_filter(SPECTRUM, IMAGE, gain)

    large = nf.nonlocal_operator(torch.zeros(1, 1, 129, 128), num_landmarks=5, photometric_bandwidth=0.5)
    return {
        "no operator": lambda: nf.polynomial_filter(None, IMAGE, ONES),  # type: ignore[arg-type]
        "an operator for a spectrum": lambda: nf.diffusion_map(BUILT, time=1.0),  # type: ignore[arg-type]
        "a number for a response": response(0.5),
        "a response without a value": response(lambda values: None),
        "a response of too few values": response(lambda values: values[:, :3]),
        "a response of NaN": response(lambda values: values * NAN),
        "a text for a loss": lambda: nf.fit_alpha(BUILT, IMAGE, IMAGE, loss="l1"),  # type: ignore[arg-type]
        "a loss without a value": lambda: nf.fit_alpha(BUILT, IMAGE, IMAGE, loss=lambda a, b: None),  # type: ignore[arg-type, return-value]
        "coefficients of another rank": lambda: SPECTRUM.synthesize(torch.sqrt, torch.ones(2, 3, 19)),
        "powers of a huge order": lambda: BUILT.powers(IMAGE, 10**12),
        "an operator of integers": lambda: BUILT.to(torch.int32),
        "a dense matrix of a large image": large.to_dense,
        "features of another size": lambda: nf.operator_from_features(torch.ones(1, 3, 10), size=(3, 4)),
        "features of a text": lambda: nf.operator_from_features("features", size=(3, 4)),  # type: ignore[arg-type]
        "weights of another size": lambda: nf.operator_from_features(
            torch.rand(1, 3, 12), size=(3, 4), weights=torch.ones(1, 5)
        ),
        "a halo larger than the image": lambda: FITTED.layers(SINGLE, halo=(4, 4)),
        "an origin of text": lambda: FITTED.layers(SINGLE, origin="top"),  # type: ignore[arg-type]
        "an empty region": lambda: nf.diffusion_mask(SPECTRUM, EMPTY),
        "a negative region": lambda: nf.diffusion_mask(SPECTRUM, -PAINTED),
        "a window of even width": lambda: nf.nonlocal_operator(GREY, patch_weights=torch.ones(4, 4)),
        "a group of text": lambda: nf.nonlocal_operator(GREY, group="all"),
        "a Portable of text": lambda: nf.Portable("module"),  # type: ignore[arg-type]
        "turns of the denoiser": lambda: nf.NonlocalDenoiser()(IMAGE, 0.1, turns=3),
        "weights that do not exist": lambda: nf.NonlocalDenoiser.trained("none.safetensors"),
    }


def of_edits() -> Calls:
    """Calls of edits with arguments that do not fit together."""
    black = torch.zeros_like(IMAGE)
    return {
        "recolor of grey": lambda: nfp.recolor(GREY, IMAGE, PAINTED),
        "colorize of colours": lambda: nfp.colorize(IMAGE, IMAGE, PAINTED),
        "recolor without a stroke": lambda: nfp.recolor(IMAGE, IMAGE, EMPTY),
        "defocus without a region": lambda: nfp.defocus(IMAGE, EMPTY),
        "enhance of unknown channels": lambda: nfp.enhance(IMAGE, ONES, channels="red", **FEW),
        "enhance of values far above white": lambda: nfp.enhance(255 * IMAGE, ONES, **FEW),
        "a curve of too few values": lambda: nfp.apply_look(IMAGE, red=(0.0, 1.0)),
        "a matrix of four values": lambda: nfp.apply_look(IMAGE, matrix=(1.0, 0.0, 0.0, 1.0)),
        "fit_look of no pair": lambda: nfp.fit_look([]),
        "fit_look of equal pictures": lambda: nfp.fit_look([(IMAGE, IMAGE)]),
        "fit_look of a black picture": lambda: nfp.fit_look([(IMAGE, black)]),
        "fit_look of unknown parts": lambda: nfp.fit_look([(IMAGE, IMAGE**2)], parts=("colour",)),
        "frames without references": lambda: nfp.filter_frames([SINGLE], ONES, references=[]),
        "frames of two references and distances": lambda: nfp.filter_frames(
            [SINGLE], ONES, references=[SINGLE, SINGLE], spatial_bandwidth=5.0
        ),
        "parts of a Look": lambda: nfp.Look({"colour": ONES}),
        "a part of a Look of another shape": lambda: nfp.Look({"matrix": ONES}),
        "an option of a Look": lambda: nfp.Look(colour=1),
        "learning an automatic bandwidth": lambda: nf.NonlocalAffinity(learn=("photometric_bandwidth",)),
        "learning no distance": lambda: nf.NonlocalAffinity(learn=("spatial_bandwidth",)),
    }


def of_application() -> Calls:
    """Calls of the application."""

    def recipe(text: str) -> Callable[[], object]:
        return lambda: public("Recipe").from_json(text, "file.json")

    def photograph(pixels: Tensor, path: str, depth: str = "uint8") -> Callable[[], object]:
        return lambda: public("write_photograph")(public("Photograph")(pixels, depth), path)

    return {
        "read_photograph of no file": lambda: public("read_photograph")("none.png"),
        "read_photograph of a folder": lambda: public("read_photograph")("."),
        "write_photograph of another kind": photograph(IMAGE[:1], "out.gif"),
        "write_photograph of floats as JPEG": photograph(IMAGE[:1], "out.jpg", "float32"),
        "write_photograph into no folder": photograph(IMAGE[:1], "nowhere/out.png"),
        "an unknown preset": lambda: public("find_recipe")("pretty"),
        "an unknown edit": lambda: public("Step")("embellish"),
        "an unknown parameter": lambda: public("Step")("tone", colour=1),
        "a recipe that is no JSON": recipe("alpha = 1"),
        "a recipe of a number": recipe("3"),
        "a newer recipe": recipe('{"version": 2, "steps": []}'),
        "a recipe of an unknown edit": recipe('{"version": 1, "steps": [{"edit": "embellish"}]}'),
        "a recipe of a wrong value": recipe('{"version": 1, "steps": [{"edit": "tone", "contrast": "much"}]}'),
    }
