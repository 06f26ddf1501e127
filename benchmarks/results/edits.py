"""Calls of the edits of photographs."""

from typing import Any

import torch
from torch import Tensor

import nlfilter_torch as nf
import nlfilter_torch.photo as nfp
from benchmarks.results.functions import Calls
from benchmarks.results.gradients import with_gradients
from benchmarks.results.inputs import box, image, seeded

FEW: dict[str, Any] = {"num_landmarks": 40}
SEPIA = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
BENT = (0.0, 0.4, 0.7, 1.0)


def calls(dtype: torch.dtype) -> Calls:
    """Calls on photographs of a dtype; a name and a colon begin their keys."""
    photo, grey = image("coffee", dtype), image("camera", dtype)
    return of_tones(photo, grey, dtype) | of_strokes(photo, grey, dtype) | of_looks(photo, dtype)


def of_tones(photo: Tensor, grey: Tensor, dtype: torch.dtype) -> Calls:
    """Calls of edits of brightness, and of those without strokes."""
    alpha, amount = torch.tensor([2.0, 1.5, 1.2, 1.0], dtype=dtype), torch.tensor(3.0, dtype=dtype)
    pair = torch.cat([photo, image("astronaut", dtype)])
    levels = torch.tensor([0.05, 0.1], dtype=dtype)
    regions = torch.cat([box(3, 4, dtype), box(12, 20, dtype, 9)], dim=1)
    sliders = torch.stack([alpha, 2 - alpha])
    rough = pair + 0.08 * torch.randn(pair.shape, generator=seeded(), dtype=torch.float64).to(dtype)
    plain: dict[str, Any] = {"limits": "none", "threshold": 0.0, "channels": "all", "residual": 1.0}

    def enhanced(picture: Tensor, sliders: Tensor) -> Tensor:
        return nfp.enhance(picture, sliders, **FEW)

    def within(picture: Tensor, sliders: Tensor) -> Tensor:
        return nfp.enhance(picture, sliders, regions, negative=box(18, 2, dtype), outside=2 - alpha, reach=0.8, **FEW)

    def sharpened(picture: Tensor, amount: Tensor) -> Tensor:
        return nfp.sharpen(picture, amount=amount, **FEW)

    def toned(picture: Tensor, contrast: Tensor) -> Tensor:
        return nfp.adjust_tone(picture, contrast=contrast, clarity=2.0, **FEW)

    def cleaned(picture: Tensor, noise: Tensor) -> Tensor:
        return nfp.denoise(picture, noise_level=noise, method="rule", **FEW)

    def flattened(picture: Tensor, power: Tensor) -> Tensor:
        return nfp.abstract(picture, power=power, edges=0.5, tones=6, **FEW)

    return {
        "enhance": lambda: with_gradients(enhanced, pair, alpha),
        "enhance: grey": lambda: enhanced(grey, alpha),
        "enhance: plain": lambda: nfp.enhance(photo, alpha, photometric_bandwidth="auto", **plain, **FEW),
        "enhance: regions": lambda: with_gradients(within, photo, sliders),
        "enhance: viewing size": lambda: nfp.enhance(photo, alpha, viewing_size=3e-4, spatial_bandwidth="none", **FEW),
        "sharpen": lambda: with_gradients(sharpened, pair, amount),
        "sharpen: options": lambda: nfp.sharpen(photo, guide_blur=0.0, limits="none", patch_size=3, **FEW),
        "adjust_tone": lambda: with_gradients(toned, pair, amount / 2),
        "adjust_tone: options": lambda: nfp.adjust_tone(grey, contrast=0.7, order=2, limits="none", **FEW),
        "denoise": lambda: nfp.denoise(rough),
        "denoise: grey": lambda: nfp.denoise(rough[:, :1], noise_level=0.1, strength=0.5),
        "denoise: rule": lambda: with_gradients(cleaned, rough, levels),
        "estimate_noise": lambda: nf.estimate_noise(rough),
        "estimate_noise: grey": lambda: nf.estimate_noise(grey),
        "noise_profile": lambda: nf.noise_profile(rough).levels,
        "profile_of_difference": lambda: nf.profile_of_difference(rough, grey.expand_as(rough)).levels,
        "abstract": lambda: with_gradients(flattened, pair, levels),
        "abstract: options": lambda: nfp.abstract(
            photo, edges=1.0, edge_width=1.0, patch_size=5, viewing_size=0, **FEW
        ),
        "filter_frames": lambda: list(nfp.filter_frames(pair.split(1), alpha, references=[photo], **FEW)),
        "filter_frames: plain": lambda: list(nfp.filter_frames([pair], alpha, references=pair.split(1), **plain)),
    }


def of_strokes(photo: Tensor, grey: Tensor, dtype: torch.dtype) -> Calls:
    """Calls of edits with strokes."""
    inside, outside = box(6, 8, dtype), box(15, 22, dtype, 6)
    painted = (inside + outside).clamp(max=1)
    blue = torch.tensor([0.1, 0.3, 0.9], dtype=dtype).view(1, 3, 1, 1) * inside
    mixed = blue + torch.tensor([0.8, 0.4, 0.1], dtype=dtype).view(1, 3, 1, 1) * outside
    kmeans: dict[str, Any] = {"method": "kmeans", "time": 2.0, "generator": seeded(4), "strength": 0.7}

    def recoloured(picture: Tensor, strokes: Tensor) -> Tensor:
        return nfp.recolor(picture, strokes, inside, keep=outside, reach=0.7)

    def colourised(picture: Tensor, strokes: Tensor) -> Tensor:
        return nfp.colorize(picture, strokes, painted, strength=0.9)

    def focused(picture: Tensor) -> Tensor:
        return nfp.defocus(picture, inside, background=outside, radius=2.0)

    def selected(picture: Tensor) -> Tensor:
        return nfp.region_mask(picture, inside, outside)

    return {
        "recolor": lambda: with_gradients(recoloured, photo, blue),
        "recolor: options": lambda: nfp.recolor(
            photo, blue, inside, photometric_bandwidth=0.15, spatial_bandwidth=9.0, patch_size=3, num_landmarks=40
        ),
        "colorize": lambda: with_gradients(colourised, grey, mixed),
        "colorize: k-means": lambda: nfp.colorize(grey, mixed, painted, **kmeans),
        "defocus": lambda: with_gradients(focused, photo),
        "defocus: options": lambda: nfp.defocus(photo, inside, aperture="gaussian", reach=0.5, num_landmarks=40),
        "recolor: by hand": lambda: nfp.recolor(
            photo, None, None, added=torch.cat([mixed, painted], dim=1), removed=box(8, 10, dtype)
        ),
        "region_mask": lambda: with_gradients(selected, photo),
        "region_mask: by hand": lambda: nfp.region_mask(photo, inside, added=outside, removed=box(8, 10, dtype)),
        "region_mask: options": lambda: nfp.region_mask(
            photo, inside, reach=0.8, spatial_bandwidth=12.0, num_landmarks=40
        ),
    }


def of_looks(photo: Tensor, dtype: torch.dtype) -> Calls:
    """Calls that apply and fit looks."""
    other = image("astronaut", dtype)
    parts: dict[str, Any] = {
        "alpha": (1.5, 1.0, 1.2, 1.0),
        "bands": (1.3, 1.0, 1.1, 1.0, 1.0, 1.0, 0.9),
        "texture": (1.0, 1.4, 1.0, 1.0, 1.0, 1.0),
        **dict.fromkeys(("red", "green"), BENT),
        "blue": (0.0, 0.3, 0.6, 0.9),
        "matrix": SEPIA,
        "saturation": (0.8, 0.9, 1.0, 1.1, 1.2),
        "stretch": (0.2, 0.3, 0.1),
        "local": (0.1, 0.0, 0.2, 0.0, 0.0, 0.1, 0.0, 0.1),
    }

    def under(picture: Tensor, matrix: Tensor) -> Tensor:
        return nfp.apply_look(picture, **parts | {"matrix": matrix}, amount=0.7, **FEW)

    def fitted(*pairs: tuple[Tensor, ...], **options: Any) -> list[Any]:
        look = nfp.fit_look(pairs, **options)
        looks = look if isinstance(look, tuple) else (look,)
        return [[look.to_json(), look.parts, look.explained, look.tensors, look.apply(other)] for look in looks]

    edited = photo**1.4 * torch.tensor([1.0, 0.9, 0.8], dtype=dtype).view(1, 3, 1, 1)
    warmer = other**1.4 * torch.tensor([1.0, 0.9, 0.8], dtype=dtype).view(1, 3, 1, 1)
    masks = torch.cat([box(0, 0, dtype, 16), box(8, 16, dtype, 16)], dim=1)
    return {
        "apply_look": lambda: with_gradients(under, photo, torch.tensor(SEPIA, dtype=dtype)),
        "apply_look: identity": lambda: nfp.apply_look(photo),
        "apply_look: sliders": lambda: nfp.apply_look(photo, alpha=(2.0, 1.0), viewing_size=3e-4, **FEW),
        "fit_look": lambda: fitted((photo, edited), (other, warmer)),
        "fit_look: parts": lambda: fitted((photo, edited), parts=("curves", "matrix"), order=2, generator=seeded(1)),
        "FittedLook": lambda: nfp.fit_look([(photo, edited)]),
        "FittedLook: regions": lambda: fitted((photo, edited, masks)),
        "FittedLook: sliders": lambda: fitted(
            (photo, nfp.enhance(photo, torch.tensor([2.0, 1.0, 1.0, 1.0], dtype=dtype)))
        ),
    }
