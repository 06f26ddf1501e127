"""Every public function with random arguments, one of them invalid in half of the calls.

Legal arguments must give finite values and no error; invalid ones, finite values or an error in one sentence.
"""

import math
import random
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

import nlfilter_torch as nlf
from nlfilter_torch import photo
from nlfilter_torch.photo.declared.shared_parameters import EXTENT
from tests.random_operators import SAMPLINGS, Findings, judged, log_uniform

SIDES = (4, 24)


class Scene:
    """An image, its operator, and other arguments of matching shapes."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.batch = rng.choice((1, 1, 2))
        self.size = (rng.randint(*SIDES), rng.randint(*SIDES))
        self.dtype = rng.choice((torch.float32, torch.float32, torch.float64))
        self.order = rng.randint(1, 4)
        self.regions = rng.randint(1, 3)
        self.generator = torch.Generator().manual_seed(rng.randint(0, 1 << 20))

    def noise(self, *shape: int) -> Tensor:
        """Draw values in [0, 1], sometimes with few levels."""
        levels = self.rng.choice((2, 4, 255, 1 << 20))
        values = torch.rand(shape, generator=self.generator, dtype=torch.float64)
        return ((values * levels).round() / levels).to(self.dtype)

    def image(self, channels: int) -> Tensor:
        """Draw an image (B, C, H, W), sometimes flat in one half."""
        image = self.noise(self.batch, channels, *self.size)
        if self.rng.random() < 0.3:
            image[..., self.size[1] // 2 :] = self.rng.random()
        return image

    def mask(self, channels: int) -> Tensor:
        """Draw a mask (B, C, H, W) in [0, 1] with a rectangle in every channel, which leaves the last row free."""
        mask = torch.zeros(self.batch, channels, *self.size, dtype=self.dtype)
        for plane in mask.flatten(0, 1):
            top, left = (self.rng.randint(0, side - 2) for side in self.size)
            bottom = min(top + self.rng.randint(1, 8), self.size[0] - 1)
            plane[top:bottom, left : left + self.rng.randint(1, 8)] = self.rng.choice((1, 0.5))
        return mask

    def background(self) -> Tensor:
        """Draw a mask (B, 1, H, W) in [0, 1] with a rectangle and the last row, so that no other mask covers it."""
        mask = self.mask(1)
        mask[..., -1, :] = 1
        return mask

    @cached_property
    def guide(self) -> Tensor:
        """Guide of the operator."""
        return self.image(self.rng.choice((1, 3, 2)))

    @cached_property
    def operator(self) -> nlf.NonlocalOperator:
        """Operator with a bandwidth suitable for noise; nearly the identity for some guides of two channels."""
        bandwidth, count = log_uniform(self.rng, 0.03, 1.0), self.rng.randint(1, 16)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "guide must have differences near photometric_bandwidth")
            return nlf.nonlocal_operator(self.guide, photometric_bandwidth=bandwidth, num_landmarks=count)

    @cached_property
    def spectrum(self) -> nlf.Spectrum:
        """Spectrum of the operator."""
        return self.operator.spectrum()


TOO_LARGE = 1_000_001  # as a patch size, 8 TB of weights
Kind = Callable[[Scene], Any]


def _number(least: float, most: float) -> Kind:
    """A number, or a tensor with one number per image."""

    def kind(scene: Scene) -> float | Tensor:
        if scene.rng.random() < 0.7:
            return scene.rng.uniform(least, most)
        return torch.tensor([scene.rng.uniform(least, most) for _ in range(scene.batch)], dtype=scene.dtype)

    return kind


def _plain(least: float, most: float) -> Kind:
    return lambda scene: scene.rng.uniform(least, most)


def _count(least: int, most: int) -> Kind:
    return lambda scene: scene.rng.randint(least, most)


def _one_of(*values: Any) -> Kind:
    return lambda scene: scene.rng.choice(values)


def _image(*channels: int) -> Kind:
    return lambda scene: scene.image(scene.rng.choice(channels))


def _alpha(scene: Scene) -> Tensor:
    shape = scene.rng.choice(((scene.order + 1,), (scene.batch, scene.order + 1)))
    return 4 * torch.rand(shape, generator=scene.generator).to(scene.dtype)


def _weights(scene: Scene) -> Tensor:
    """Weights of pixels, some of them 0."""
    weights = (9 * scene.noise(scene.batch, 1, *scene.size) - 3).clamp(min=0.0)
    weights[..., 0, 0] = 1.0
    return weights


def _size(scene: Scene) -> tuple[int, int]:
    return scene.size


def _points(scene: Scene) -> Tensor:
    return 5 * scene.noise(scene.batch, 3, math.prod(scene.size))


def _background(scene: Scene) -> Tensor:
    return scene.background()


def _short_side(part: float) -> Kind:
    return lambda scene: scene.rng.uniform(0.1, part * min(scene.size))


AFFINITY: dict[str, Kind] = {
    "patch_size": _one_of(1, 3, 5),
    "spatial_bandwidth": _plain(0.5, 30.0),
    "num_landmarks": _count(1, 16),
    "landmarks": _one_of(*SAMPLINGS),
    "completion": _one_of("diagonal"),
    "generator": lambda scene: scene.generator,
}
BANDWIDTH = {"photometric_bandwidth": _one_of("auto", 0.05, 0.2)}
GUIDED = {"guide_channels": _one_of("luminance", "all")}
HELD: dict[str, Kind] = {"hold": _one_of(None, "assignment")}
BALANCED: dict[str, Kind] = {"tolerance": _plain(1e-6, 1e-3)}
LOCAL = {name: AFFINITY[name] for name in ("patch_size", "spatial_bandwidth", "num_landmarks")}
FILTER = AFFINITY | BANDWIDTH
OPERATOR: dict[str, Kind] = {"operator": lambda scene: scene.operator}
SPECTRUM: dict[str, Kind] = {"spectrum": lambda scene: scene.spectrum}
REGION: dict[str, Kind] = {"region": lambda scene: scene.mask(scene.regions)}
REGIONS: dict[str, Kind] = {"regions": REGION["region"]}
NEGATIVE: dict[str, Kind] = {"negative": lambda scene: scene.mask(1)}
REMOVED: dict[str, Kind] = {"removed": NEGATIVE["negative"]}
BY_HAND = {"added": NEGATIVE["negative"]} | REMOVED
IMAGE = {"image": _image(1, 3, 2)}
PAINTED: dict[str, Kind] = {"strokes": _image(3), "stroke_mask": lambda scene: scene.mask(1)}
ALPHA: dict[str, Kind] = {"alpha": _alpha}
ROWS: dict[str, Kind] = {"alpha": lambda scene: 4 * scene.noise(scene.regions, scene.order + 1)}
LIST: dict[str, Kind] = {"alpha": lambda scene: [scene.rng.uniform(0, 4) for _ in range(scene.order + 1)]}
RESIDUAL = {"residual": _plain(0.0, 2.0)}
TIME = {"time": _number(0.1, 5.0)}
WIDTH = {"width": _number(0.5, 8.0)}
LOGITS: dict[str, Kind] = {"logits": _image(1, 2, 4)}
REFINED: dict[str, Kind] = {
    "steps": _count(1, 5),
    "strength": _number(0, 10),
    "margin": _number(0.5, 5),
    "caution": _plain(0.05, 1),
    "confidence": lambda scene: scene.mask(1),
}
AFFINITY_OF_GUIDE = {name: kind for name, kind in FILTER.items() if name != "completion"} | GUIDED
ORDER: dict[str, Kind] = {"order": lambda scene: scene.order}


def _responses(scene: Scene) -> Callable[[Tensor], Tensor]:
    power = scene.rng.uniform(0.1, 3.0)
    return scene.rng.choice((lambda x: x**power, lambda x: (1 - x) * x.sqrt(), torch.ones_like, lambda x: x))


def _wrong_response(scene: Scene) -> Any:
    return scene.rng.choice((lambda x: None, lambda x: "text", lambda x: x[:, :1], None, 1.0))


def _layer(**options: Any) -> Tensor:
    image, guide = options.pop("image"), options.pop("guide", None)
    return nlf.NonlocalFilter(options.pop("alpha"), **options)(image, guide)


def _affinity(**options: Any) -> Tensor:
    image = options.pop("image")
    return nlf.NonlocalAffinity(**options)(image) @ image


def _collated(samples: list[Any]) -> Tensor:
    batch = nlf.collate(samples)
    return batch.row_sums() if isinstance(batch, nlf.NonlocalOperator) else torch.zeros(1)


def _block(image: Tensor, **options: Any) -> Tensor:
    """Apply an untrained block, which leaves the image as it is."""
    channels = image.shape[1] if isinstance(image, Tensor) and image.ndim > 1 else 3
    block = nlf.NonlocalBlock(channels, **options).eval()
    return block.to(image.dtype)(image) if isinstance(image, Tensor) and image.is_floating_point() else block(image)


def _denoiser(image: Tensor, noise: float | Tensor = 0.1) -> Tensor:
    """Denoise with an untrained network."""
    return nlf.NonlocalDenoiser()(image, noise)


def _portable(image: Tensor, alpha: list[float]) -> Tensor:
    """A layer in its portable form, which differs from the layer only during export."""
    return nlf.Portable(nlf.NonlocalFilter(alpha, num_landmarks=10))(image)


def _sliders(operator: nlf.NonlocalOperator, image: Tensor, **options: Any) -> Tensor:
    return nlf.PolynomialSliders(options.pop("alpha"), **options)(operator, image)


def _diffusion_module(spectrum: nlf.Spectrum, region: Tensor, **options: Any) -> Tensor:
    return nlf.DiffusionMask(**options)(spectrum, region)


def _segment_module(spectrum: nlf.Spectrum, regions: Tensor, **options: Any) -> Tensor:
    return nlf.SegmentMask(**options)(spectrum, regions)


def _refine_module(logits: Tensor, guide: Tensor, **options: Any) -> Tensor:
    confidence = options.pop("confidence", None)
    return nlf.Refine(**options)(logits, guide, confidence)


def _restored(operator: nlf.NonlocalOperator, image: Tensor, strength: float) -> Tensor:
    """Restore an image of which every other column is known."""

    width = operator.size[-1] if isinstance(operator, nlf.NonlocalOperator) else 0

    def known(x: Tensor) -> Tensor:
        return x[..., ::2]

    def put_back(y: Tensor) -> Tensor:
        return y if y.ndim == 0 else torch.stack([y, torch.zeros_like(y)], dim=-1).flatten(-2)[..., :width]

    dense = isinstance(image, Tensor) and image.ndim == 4 and image.layout == torch.strided
    prior = nlf.NonlocalPrior(operator)
    return nlf.restore(known(image) if dense else image, known, put_back, prior, strength=strength, steps=5).image


def _fitted_layer(image: Tensor, target: Tensor) -> float:
    learn = ("alpha", "photometric_bandwidth")
    layer = nlf.NonlocalFilter((1.0, 1.0), num_landmarks=9, photometric_bandwidth=0.2, learn=learn)
    return nlf.fit_layer(layer, image, target, evaluations=60).error


def _look(**options: Any) -> Tensor:
    image = options.pop("image")
    return photo.Look(**options)(image)


def _fitted_look(before: Tensor, **options: Any) -> Tensor:
    after = before.square() if isinstance(before, Tensor) else before
    look = photo.fit_look([(before, after)], **options)
    assert isinstance(look, photo.FittedLook)
    return torch.tensor([look.fitted, look.left_out])


def _first(scene: Scene) -> Tensor:
    return scene.image(3)[:1]


@dataclass(frozen=True)
class Function:
    """A public function, its required arguments, and its optional ones."""

    call: Callable[..., Any]
    required: dict[str, Kind]
    optional: dict[str, Kind]


NUMBERS = {name: _plain(0.1, 4.0) for name in ("time", "width")}
FUNCTIONS = {
    "nonlocal_operator": Function(
        nlf.nonlocal_operator, {"guide": _image(1, 3, 2)}, FILTER | GUIDED | BALANCED | {"weights": _weights}
    ),
    "operator_from_features": Function(
        nlf.operator_from_features,
        {"features": _points, "size": _size},
        {name: kind for name, kind in AFFINITY.items() if name not in ("patch_size", "spatial_bandwidth")}
        | BALANCED
        | {"weights": lambda scene: 0.5 + 9 * scene.noise(math.prod(scene.size))},
    ),
    "NonlocalOperator.matmul": Function(lambda operator, image: operator @ image, OPERATOR | IMAGE, {}),
    "NonlocalOperator.spectrum": Function(
        lambda operator, **options: operator.spectrum(**options), OPERATOR, {"rank": _count(1, 20)}
    ),
    "NonlocalOperator.cat": Function(
        lambda operator, image: nlf.NonlocalOperator.cat([operator, operator])[: len(operator)] @ image,
        OPERATOR | IMAGE,
        {},
    ),
    "pad_images": Function(nlf.pad_images, {"images": lambda scene: list(scene.image(3))}, {}),
    "collate": Function(_collated, {"samples": lambda scene: [scene.operator, scene.operator]}, {}),
    "polynomial_filter": Function(nlf.polynomial_filter, OPERATOR | IMAGE | ALPHA, RESIDUAL),
    "detail_layers": Function(nlf.detail_layers, OPERATOR | IMAGE, ORDER),
    "spectral_filter": Function(
        lambda spectrum, **options: nlf.spectral_filter(spectrum, **options),
        SPECTRUM | IMAGE | {"response": _responses},
        RESIDUAL,
    ),
    "spectral_filter of the operator": Function(
        nlf.spectral_filter, OPERATOR | IMAGE | {"response": _responses}, {"tolerance": _plain(1e-4, 1e-2)}
    ),
    "apply_function": Function(
        lambda *arguments, **options: nlf.apply_function(*arguments, **options).image,
        OPERATOR | IMAGE | {"response": _responses},
        {"tolerance": _plain(1e-4, 1e-2)},
    ),
    "polynomial_response": Function(
        nlf.polynomial_response, {"eigenvalues": lambda scene: scene.noise(scene.batch, 5), **ALPHA}, {}
    ),
    "captured_energy": Function(nlf.captured_energy, SPECTRUM | IMAGE, {}),
    "estimate_bandwidth": Function(nlf.estimate_bandwidth, {"guide": _image(1, 3, 2)}, GUIDED | {"weights": _weights}),
    "estimate_noise": Function(nlf.estimate_noise, IMAGE, {}),
    "standard_error": Function(
        lambda image, noise: nlf.standard_error(lambda values: 0.4 * values, image, noise),
        {"image": _image(1, 3, 2), "noise": _number(0.01, 0.3)},
        {},
    ),
    "noise_profile": Function(lambda image: nlf.noise_profile(image).levels, IMAGE, {}),
    "profile_of_difference": Function(
        lambda noisy, clean: nlf.profile_of_difference(noisy, clean).levels,
        {"noisy": _image(3), "clean": _image(3)},
        {},
    ),
    "diffusion_map": Function(nlf.diffusion_map, SPECTRUM | TIME, {}),
    "diffusion_mask": Function(nlf.diffusion_mask, SPECTRUM | REGION, TIME | WIDTH | NEGATIVE),
    "segment_mask": Function(nlf.segment_mask, SPECTRUM | REGIONS, TIME | {"temperature": _number(0, 8)}),
    "refine": Function(nlf.refine, LOGITS | {"guide": _image(1, 3, 2)}, REFINED | AFFINITY_OF_GUIDE),
    "compose_alpha": Function(nlf.compose_alpha, {"masks": REGION["region"]} | ROWS, {}),
    "filter_regions": Function(nlf.filter_regions, OPERATOR | IMAGE | {"masks": REGION["region"]} | ROWS, RESIDUAL),
    "propagate_strokes": Function(
        nlf.propagate_strokes,
        SPECTRUM | PAINTED,
        {"strength": _number(0, 1), "reach": _number(0, 0.99), "smoothness": _number(0.1, 10)},
    ),
    "fit_alpha": Function(
        nlf.fit_alpha,
        OPERATOR | {"image": _image(3), "target": _image(3)},
        ORDER
        | {"mask": NEGATIVE["negative"], "ridge": _plain(0, 1), "shared": _one_of(True, False)}
        | {"rounding": _plain(0, 0.01)},
    ),
    "filter_frames": Function(
        lambda **arguments: list(photo.filter_frames(**arguments)),
        {
            "frames": lambda scene: [scene.image(3) for _ in range(2)],
            "references": lambda scene: [_first(scene)],
            "alpha": lambda scene: 4 * scene.noise(scene.order + 1),
        },
        RESIDUAL | FILTER,
    ),
    "sure": Function(
        lambda operator, **options: nlf.sure(operator, **options),
        OPERATOR | {"image": _image(1, 3), "noise": _number(0.01, 0.3)},
        ALPHA,
    ),
    "propagate_labels": Function(
        nlf.propagate_labels,
        OPERATOR | {"labels": lambda scene: torch.tensor([[0, 1, *[-1] * (math.prod(scene.size) - 2)]] * scene.batch)},
        {"strength": _plain(0.1, 200)},
    ),
    "bandwidth_of_points": Function(nlf.bandwidth_of_points, {"points": _points}, {"k": _count(1, 10)}),
    "neighbour_distances": Function(nlf.neighbour_distances, {"points": _points}, {"k": _count(1, 10)}),
    "NonlocalPrior": Function(
        lambda operator, form, **arguments: nlf.NonlocalPrior(operator, form).prox(**arguments),
        OPERATOR | {"form": _one_of("red", "plug-and-play"), "x": _image(1, 3), "g": _number(0, 10)},
        {},
    ),
    "restore": Function(_restored, OPERATOR | {"image": _image(1, 3), "strength": _plain(0.1, 3)}, {}),
    "fit_layer": Function(
        _fitted_layer, {"image": lambda scene: scene.noise(1, 1, 8, 8), "target": lambda s: s.noise(1, 1, 8, 8)}, {}
    ),
    "fit_filter": Function(
        lambda **arguments: nlf.fit_filter(**arguments).moments,
        {
            "operator": lambda scene: nlf.nonlocal_operator(scene.guide[:1], num_landmarks=8),
            "image": _first,
        },
        ORDER,
    ),
    "enhance": Function(photo.enhance, {"image": _image(1, 3)} | ALPHA, RESIDUAL | FILTER),
    "enhance with regions": Function(
        photo.enhance,
        {"image": _image(1, 3)} | REGIONS | ROWS,
        RESIDUAL
        | FILTER
        | {"added": REGION["region"], "reach": _plain(0.1, 0.9), "mask_bandwidth": _plain(0.03, 0.5)}
        | REMOVED,
    ),
    "sharpen": Function(
        photo.sharpen, {"image": _image(1, 3)}, FILTER | {"amount": _number(0, 8), "guide_blur": _short_side(0.5)}
    ),
    "adjust_tone": Function(
        photo.adjust_tone,
        {"image": _image(1, 3)},
        FILTER | ORDER | {"contrast": _number(0, 2), "clarity": _number(0, 4)},
    ),
    "denoise": Function(
        photo.denoise,
        IMAGE,
        LOCAL
        | {
            "noise_level": _number(0, 0.3),
            "strength": _number(0, 3),
            "brightness": _number(0, 1),
            "colour": _number(0, 1),
            "grain": _number(0, 1),
            "method": _one_of("network", "rule"),
            "photometric_bandwidth": _plain(0.03, 0.5),
        },
    ),
    "abstract": Function(
        photo.abstract,
        {"image": _image(1, 3)},
        LOCAL
        | BANDWIDTH
        | {"power": _number(0, 2), "edges": _plain(0, 1), "edge_width": _short_side(0.5)}
        | {"tones": _count(2, 9)},
    ),
    "adjust_light": Function(
        photo.adjust_light,
        {"image": _image(1, 3), "region": lambda scene: scene.mask(1)},
        LOCAL
        | BY_HAND
        | {name: _number(-1, 1) for name in ("exposure", "contrast", "shadows", "whites", "warmth", "vibrance")}
        | {"temperature": _plain(2000, 15000), "photometric_bandwidth": _plain(0.03, 0.5)},
    ),
    "heal": Function(
        photo.heal,
        {"image": _image(1, 3), "spots": lambda scene: scene.mask(1)},
        {"reach": _plain(1, 20)},
    ),
    "defocus": Function(
        photo.defocus,
        {"image": _image(1, 3), "focus_region": lambda scene: scene.mask(1)},
        LOCAL
        | BY_HAND
        | {"radius": _short_side(0.5), "aperture": _one_of("disc", "gaussian")}
        | {"photometric_bandwidth": _plain(0.03, 0.5)},
    ),
    "region_mask": Function(
        photo.region_mask,
        {"image": _image(1, 3), "scribbles": lambda scene: scene.mask(1)},
        LOCAL
        | BY_HAND
        | {
            "reach": _number(0, 0.99),
            "extent": _one_of(*EXTENT.choices),
            "photometric_bandwidth": _plain(0.03, 0.5),
            "box": lambda scene: (0.0, 0.0, float(scene.size[1]), float(scene.size[0])),
        },
    ),
    "cutout": Function(photo.cutout, {"image": _image(1, 3), "mask": lambda scene: scene.mask(1)}, {}),
    "recolor": Function(
        photo.recolor,
        {"image": _image(3)} | PAINTED,
        LOCAL
        | REMOVED
        | {
            "added": lambda scene: torch.cat([PAINTED["strokes"](scene), scene.mask(1)], dim=1),
            "keep": _background,
            "reach": _number(0, 0.99),
            "brightness": _number(0, 1),
            "extent": _one_of(*EXTENT.choices),
            "photometric_bandwidth": _plain(0.03, 0.5),
        },
    ),
    "colorize": Function(
        photo.colorize,
        {"grey": _image(1)} | PAINTED,
        LOCAL
        | {"method": _one_of("regression", "kmeans"), "strength": _number(0, 1), "time": _number(0.1, 5)}
        | {"photometric_bandwidth": _plain(0.03, 0.5)},
    ),
    "apply_look": Function(
        photo.apply_look,
        {"image": _image(1, 3)},
        FILTER
        | {"alpha": lambda scene: 4 * scene.noise(scene.order + 1), "bands": lambda scene: 2 * scene.noise(7)}
        | {"matrix": lambda scene: scene.noise(9), "amount": _number(0, 2)}
        | {"texture": lambda scene: 2 * scene.noise(6), "saturation": lambda scene: 2 * scene.noise(5)}
        | {"stretch": lambda scene: scene.noise(3), "local": lambda scene: scene.noise(8)}
        | {"lattice": lambda scene: scene.noise(3, 3, 3, 3)},
    ),
    "fit_look": Function(
        _fitted_look,
        {"before": lambda scene: scene.noise(1, 3, 24, 24)},
        ORDER | {"parts": _one_of(("curves",), ("alpha", "matrix"))},
    ),
    "Look": Function(_look, {"image": _image(3)}, {"learn": _one_of((), ("matrix",)), "knots": _count(2, 20)}),
    "NonlocalFilter": Function(
        _layer,
        LIST | {"image": _image(1, 3)},
        RESIDUAL | FILTER | GUIDED | BALANCED | HELD | {"learn": _one_of((), ("alpha",))},
    ),
    "NonlocalAffinity": Function(
        _affinity, {"image": _image(1, 3)}, FILTER | GUIDED | BALANCED | HELD | {"learn": _one_of(())}
    ),
    "NonlocalBlock": Function(
        _block,
        {"image": _image(1, 3, 2)},
        {
            "inner_channels": _count(1, 4),
            "embedding_channels": _count(1, 4),
            "num_landmarks": AFFINITY["num_landmarks"],
            "landmarks": AFFINITY["landmarks"],
            "temperature": _plain(0.1, 8.0),
            "spatial_bandwidth": AFFINITY["spatial_bandwidth"],
            "norm": _one_of("batch", "none"),
            "learn": _one_of((), ("temperature",)),
        },
    ),
    "NonlocalDenoiser": Function(_denoiser, {"image": _image(1, 3)}, {"noise": _number(0, 0.3)}),
    "Portable": Function(_portable, LIST | {"image": _image(1, 3)}, {}),
    "PolynomialSliders": Function(_sliders, OPERATOR | IMAGE | LIST, RESIDUAL | {"learn": _one_of((), ("alpha",))}),
    "DiffusionMask": Function(
        _diffusion_module, SPECTRUM | REGION, NUMBERS | {"learn": _one_of((), ("time", "width"))}
    ),
    "Refine": Function(
        _refine_module,
        LOGITS | {"guide": _image(1, 3, 2)},
        {name: kind for name, kind in (REFINED | AFFINITY_OF_GUIDE).items() if name != "generator"}
        | {"strength": _plain(0.1, 10), "margin": _plain(0.5, 5), "learn": _one_of((), ("strength", "margin"))},
    ),
    "SegmentMask": Function(
        _segment_module, SPECTRUM | REGIONS, {"time": NUMBERS["time"], "temperature": _plain(0, 8)}
    ),
}


@dataclass(frozen=True)
class Call:
    """A function, its arguments, and the name of the invalid one."""

    name: str
    arguments: dict[str, Any]
    wrong: str | None

    def __str__(self) -> str:
        """Describe the call in one line."""
        shown = ", ".join(f"{name}={_shown(value)}" for name, value in self.arguments.items())
        return f"{self.name}({shown}){'' if self.wrong is None else ' with a wrong ' + self.wrong}"


def random_call(rng: random.Random) -> Call:
    """Draw a public function and its arguments, one of them invalid in half of the calls."""
    name = rng.choice(tuple(FUNCTIONS))
    function, scene = FUNCTIONS[name], Scene(rng)
    arguments = {key: kind(scene) for key, kind in function.required.items()}
    arguments |= {key: kind(scene) for key, kind in function.optional.items() if rng.random() < 0.4}
    if "num_landmarks" in function.optional:  # the default may exceed the number of pixels
        arguments.setdefault("num_landmarks", 16)
    candidates = [key for key in arguments if "." not in name or key != "operator"]  # a method needs its operator
    wrong = rng.choice(candidates) if candidates and rng.random() < 0.5 else None
    if wrong is not None:
        arguments[wrong] = _wrong_response(scene) if wrong == "response" else _wrong(rng, wrong, arguments[wrong])
    return Call(name, arguments, wrong)


def check_call(call: Call) -> Findings:
    """Make the call, and check its result."""
    findings, made = Findings(), None
    with judged(findings, legal=call.wrong is None):
        made = FUNCTIONS[call.name].call(**call.arguments)
    for tensor in _tensors(made):
        findings.finite(tensor, "the result")
    return findings


def _wrong(rng: random.Random, name: str, value: Any) -> Any:
    """Draw a replacement for an argument; it may happen to be legal."""
    if isinstance(value, Tensor) and value.ndim > 0 and rng.random() < 0.8:
        return rng.choice(TENSORS)(value)
    if isinstance(value, list) and value and rng.random() < 0.6:
        return [*value[:-1], _wrong(rng, name, value[-1])]
    choices: list[Any] = [None, "text", "", [], (), {}, math.nan, math.inf, -1, -1.5, 0, 0.5, True, 1j, "nan", b"1"]
    choices += [torch.tensor(math.nan), torch.ones(7), torch.tensor([]), torch.tensor(1j), torch.tensor(-1.0)]
    choices += [1e20, 1e-40, -math.inf]
    if name in ("patch_size", "num_landmarks"):
        choices += [TOO_LARGE, 10**400, 2, 48.0]
    return rng.choice(choices)


def _with(tensor: Tensor, value: float) -> Tensor:
    changed = tensor.clone() if tensor.is_floating_point() else tensor.double()
    changed.view(-1)[-1] = value
    return changed


TENSORS: tuple[Callable[[Tensor], Any], ...] = (
    lambda t: _with(t, math.nan),
    lambda t: _with(t, math.inf),
    lambda t: _with(t, 1e20),
    lambda t: t * 1e20,
    lambda t: t * 1e-40,
    lambda t: t * 255,
    lambda t: -t,
    lambda t: t * 0,
    lambda t: t.long(),
    lambda t: t.bool(),
    lambda t: t.half(),
    lambda t: t.to(torch.complex64),
    lambda t: t[0],
    lambda t: t[None],
    lambda t: t[..., :0],
    lambda t: t[:0],
    lambda t: t[..., :-1],
    lambda t: torch.cat([t] * 5),
    lambda t: torch.cat([t] * 5, dim=min(1, t.ndim - 1)),
    lambda t: t.mT.contiguous().mT if t.ndim > 1 else t.flip(0),
    lambda t: t.to_sparse(),
    lambda t: t.numpy(),
    lambda t: t.tolist(),
    lambda t: t.clone().requires_grad_(t.is_floating_point()),
)


def _tensors(value: Any) -> Iterable[Tensor]:
    """Yield the tensors of a result that must be finite."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _tensors(part)
    elif isinstance(value, nlf.NonlocalOperator):
        yield from (value.factor, value.diagonal, value.scaling, value.residual)
    elif isinstance(value, nlf.Spectrum):
        yield from (value.eigenvalues, value.eigenvectors)


def _shown(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')}{tuple(value.shape)}" if value.numel() != 1 else str(value)
    if isinstance(value, nlf.NonlocalOperator | nlf.Spectrum | torch.Generator):
        return type(value).__name__
    return "a function" if callable(value) else repr(value)[:60]
