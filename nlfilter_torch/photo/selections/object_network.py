"""A small network that corrects where the model of an object is often wrong.

It sees what the model knows of each pixel, its means at four scales, and how much colours there differ from those
nearby that the model takes for the object and for its background. All these are the same in turned and mirrored
pictures, so that results turn with them. Two layers of 64 and 32 numbers per pixel make a correction of the model's log
odds from them. The weights were learned on outlines of objects in photographs under free licences, and on these objects
over other photographs, from random strokes: ``python -m benchmarks.training.selections``.
"""

import math
from functools import cache
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.nn.denoiser.weights import read_weights
from nlfilter_torch.photo.picture.resizing import block_means, enlarged
from nlfilter_torch.photo.selections.scribbled_colours import EPSILON

TRAINED = Path(__file__).with_name("object_network.safetensors")
TRAINED_PIXELS = 1 << 13  # of the reduced picture in which it was trained
BLOCK = 1024  # pixels along an axis of which means are computed together
SIGMAS = (1.5, 4.0, 10.0, 25.0)  # of means, in pixels of that picture: from a thin part to most of an object
STROKES_ALONE = 0.75  # share of its odds if only strokes on the object are given: it takes in what no side explains
EVIDENCE_PLANES = (3, 3, 6, 2, 2, 2)  # of the evidence
FEATURES, WIDTHS = 93, (64, 32)
SHAPES = {
    "mean": (FEATURES,),
    "std": (FEATURES,),
    "first.weight": (WIDTHS[0], FEATURES),
    "first.bias": (WIDTHS[0],),
    "second.weight": (WIDTHS[1], WIDTHS[0]),
    "second.bias": (WIDTHS[1],),
    "out.weight": (1, WIDTHS[1]),
    "linear.weight": (1, FEATURES),
    "linear.bias": (1,),
    "scale": (1,),
}


@cache
def trained() -> dict[str, Tensor]:
    """The weights that come with the package, float32."""
    return read_weights(TRAINED, SHAPES)


def corrected(evidence: Tensor) -> Tensor:
    """Log odds (h, w) that pixels belong to an object.

    Args:
        evidence: what the model knows, (18, h, w): Lab and the strength of textures, in hundredths; log odds by colour
            from the strokes and from the last cut, and the log density on the likelier side, relative to rare colours;
            the regression, :func:`nearness` and :func:`radii_beyond`; weights of what is known of both sides, and those
            of strokes alone; whether a pixel is free to belong to the object, and its mask. Differentiable.
    """
    size = (evidence.shape[-2], evidence.shape[-1])
    coarse = coarse_evidence(evidence)
    shape = (coarse.shape[-2], coarse.shape[-1])
    weights = {name: weight.to(coarse) for name, weight in trained().items()}
    correction = correction_of(features(coarse).flatten(1).mT, weights).view(1, 1, *shape)
    correction = enlarged(correction, (size[0] / shape[0], size[1] / shape[1]), (0, 0), size)[0, 0]
    odds = correction + weights["scale"] * odds_of(evidence[-1])
    opposed, free, mask = evidence[-3], evidence[-2], evidence[-1]
    alone = not bool((opposed > 0).any() | (free < 1).any())
    return torch.lerp(mask.logit(1e-3), odds, STROKES_ALONE) if alone else odds


def coarse_evidence(evidence: Tensor) -> Tensor:
    """Evidence at the resolution of the network, with how much pixels differ from their neighbours, (19, h, w)."""
    size = (evidence.shape[-2], evidence.shape[-1])
    lab, padded = evidence[:3], F.pad(evidence[:3], (1, 1, 1, 1), mode="replicate")
    around = [padded[:, i : i + size[0], j : j + size[1]] for i in range(3) for j in range(3)]
    squared = torch.stack([(lab - beside).square().sum(0) for beside in around]).mean(0, keepdim=True)
    evidence = torch.cat([evidence, squared / (2 * squared.mean() + EPSILON)])
    return block_means(evidence.unsqueeze(0), max(1.0, math.sqrt(size[0] * size[1] / TRAINED_PIXELS))).squeeze(0)


def correction_of(points: Tensor, weights: dict[str, Tensor]) -> Tensor:
    """The correction (...) of the log odds of points with :func:`features` (..., F)."""
    points = ((points - weights["mean"]) / weights["std"]).clamp(-4.0, 4.0)
    hidden = F.silu(F.linear(points, weights["first.weight"], weights["first.bias"]))
    hidden = F.silu(F.linear(hidden, weights["second.weight"], weights["second.bias"]))
    linear = F.linear(points, weights["linear.weight"], weights["linear.bias"])
    return (F.linear(hidden, weights["out.weight"]) + linear).squeeze(-1)


def odds_of(mask: Tensor) -> Tensor:
    """Log odds of a mask; those of pixels that the model is sure of are limited, as it may be wrong there."""
    return mask.clamp(0.02, 0.98).logit()


def features(evidence: Tensor) -> Tensor:
    """What the network sees of each pixel, (F, h, w), from :func:`coarse_evidence`.

    Factors bring all of it to about [-1, 1].
    """
    lab, texture, known, sides, drawn, (free, mask), (contrast,) = evidence.split((*EVIDENCE_PLANES, 1))
    first, last, density, likely, near, away = known
    first, last, odds = (first / 8).tanh(), (last / 8).tanh(), odds_of(mask) / 2
    planes = [first, last, density.clamp(0.0, 30.0) / 15, 2 * likely.clamp(0.0, 1.0) - 1, near]
    contrast, likely = contrast.clamp(max=4.0) / 2, planes[3]
    pooled = torch.stack([*planes, odds, 2 * mask - 1, *sides, contrast])
    look, shares = torch.cat([lab * 4, texture * 8]), torch.stack([mask * free, 1 - mask, *sides.clamp(max=1.0)])
    total = shares.sum((1, 2)).view(-1, 1, 1, 1)
    means = (look * shares.unsqueeze(1)).sum((2, 3), keepdim=True) / total.clamp(min=EPSILON)
    means = torch.cat([means[:2], torch.where(total[2:] > 0, means[2:], means[:2])])  # of strokes, where there are any
    result = [*planes, away / 2 - 1, *sides, *drawn, free, odds, contrast, 2 * mask - 1]
    inner, outer = apart(look, means[0]), apart(look, means[1])
    result += [*inner.clamp(max=3.0), *outer.clamp(max=3.0), closer(inner, outer)]
    result.append(closer(apart(look, means[2]), apart(look, means[3])))
    for sigma in SIGMAS:
        result += nearby(pooled, look, shares, means, sigma)
    result += places(shares[0], free > 0.5)
    shown = (drawn.mean((1, 2)) + 1e-9).sqrt() * 5  # the derivative of the root is finite
    within = [
        (shares[side] * plane).sum() / total[side].clamp(min=EPSILON)
        for side, plane in ((0, first), (1, first), (0, likely))
    ]
    of_all = [*shown, mask.mean(), (odds.abs() < 1).to(mask).mean(), (drawn[1] > 0).any().to(mask), *within]
    return torch.stack(result + [value.reshape(()).expand_as(mask) for value in of_all])


def apart(look: Tensor, mean: Tensor) -> Tensor:
    """How much lightness, chroma and texture (6, h, w) differ from a mean, which may vary, (3, h, w)."""
    parts = (look - mean).square().split((1, 2, 3))
    return torch.stack([(part.sum(0) + 1e-6).sqrt() for part in parts])


def closer(inner: Tensor, outer: Tensor) -> Tensor:
    """How much closer in colour pixels are to an object than to its background, (h, w), from :func:`apart` of both."""
    inside, outside = ((part[0].square() + 2 * part[1].square() + 0.02).log() for part in (inner, outer))
    return (outside - inside) / 2


def nearby(pooled: Tensor, look: Tensor, shares: Tensor, means: Tensor, sigma: float) -> list[Tensor]:
    """Means of planes around each pixel, and how it differs from the mean looks of both sides there.

    Args:
        pooled: planes, (C, h, w).
        look: colours and textures, (6, h, w).
        shares: of the pixels in the object, the background, and what is known of them, (4, h, w).
        means: looks of these in the whole picture, which count where there is little of them nearby, (4, 6, 1, 1).
        sigma: of the means.
    """
    planes = torch.cat([pooled, shares, (look * shares.unsqueeze(1)).flatten(0, 1)])
    around, weights, sums = blurred(planes, sigma).split([len(pooled), 4, 24])
    weights, few = weights.unsqueeze(1), look.new_tensor([0.02, 0.02, 0.003, 0.003]).view(4, 1, 1, 1)
    looks = (sums.unflatten(0, (4, 6)) + few * means) / (weights + few)
    inner, outer = apart(look, looks[0]), apart(look, looks[1])
    near, far = inner.clamp(max=3.0), outer.clamp(max=3.0)
    result = [*around, near[0] + near[1], far[0] + far[1], near[2] - far[2], closer(inner, outer)]
    # Strokes are too thin for a narrow mean to reach other pixels.
    return result if sigma < 5 else [*result, closer(apart(look, looks[2]), apart(look, looks[3]))]


def blurred(planes: Tensor, sigma: float) -> Tensor:
    """Gaussian means (C, h, w) of pixels in the picture; sigma is for :data:`TRAINED_PIXELS` in all."""
    sigma *= math.sqrt(planes.shape[-2] * planes.shape[-1] / TRAINED_PIXELS)
    return _blurred_along(_blurred_along(planes.mT, sigma).mT, sigma)


def _blurred_along(planes: Tensor, sigma: float) -> Tensor:
    """:func:`blurred` of planes (C, h, w) along their rows, in blocks, as these may be long in a narrow picture."""
    length, reach, blocks = planes.shape[-1], math.ceil(6 * sigma), []
    at = torch.arange(length, device=planes.device).to(planes)
    for first in range(0, length, BLOCK):
        near = slice(max(first - reach, 0), first + BLOCK + reach)
        kernel = torch.exp(-0.5 * ((at[first : first + BLOCK].unsqueeze(1) - at[near]) / sigma).square())
        blocks.append(planes[..., near] @ (kernel / kernel.sum(1, keepdim=True)).mT)
    return torch.cat(blocks, dim=-1)


def places(share: Tensor, free: Tensor) -> list[Tensor]:
    """Distances (h, w) of pixels from the middle of an object, from the picture's border, and, with a box, in that.

    Args:
        share: of a pixel in the object, (h, w).
        free: whether it may belong to it, (h, w) of bool; all may, if there is no box.
    """
    height, width = share.shape
    rows, columns = (torch.arange(length, device=share.device).to(share) for length in (height, width))
    share = share / share.sum().clamp(min=EPSILON)
    down, along = (share.sum(1) * rows).sum(), (share.sum(0) * columns).sum()
    squared = (rows.unsqueeze(1) - down).square() + (columns - along).square()
    radii = (squared / ((share * squared).sum() + 1) + 1e-6).clamp(max=9.0).sqrt() - 1
    border = torch.minimum(rows, height - 1 - rows).unsqueeze(1).minimum(torch.minimum(columns, width - 1 - columns))
    result = [radii, (border / 10).clamp(max=2.0) - 1]
    if bool(free.all()) or not bool(free.any()):
        return result + [torch.zeros_like(share)] * 3
    across = []
    for free_there, at in ((free.any(1), rows), (free.any(0), columns)):
        first, last = at[free_there].aminmax()
        across.append((at - (first + last) / 2).abs() * 2 / (last - first + 1))
    upright, level = across[0].unsqueeze(1).expand(height, width), across[1].expand(height, width)
    in_box = [upright.maximum(level), (upright.square() + level.square() + 1e-6).sqrt()]
    return [*result, *(plane.clamp(max=2.0) for plane in in_box), torch.ones_like(share)]
