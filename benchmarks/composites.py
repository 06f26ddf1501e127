"""Composites with known opacity: a textured object from one photograph over another, and scribbles on both.

The shapes are random: blobs, and blobs with hairs, holes, motion blur or defocus. The photographs in
``CHOOSING`` were used to choose the defaults of masks, recolouring and defocus; those in ``REPORTING`` were not.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.harness import options
from benchmarks.photographs import CHOOSING, REPORTING, photograph, pictures

Plane = NDArray[np.float32]

SHAPES = ("blob", "hairs", "holes", "motion", "soft")
SIZE = (112, 160)
RADIUS, LENGTH = 0.014, 0.14  # of a scribble, as shares of the short side
BAND = 0.06  # of a trimap: width on either side of its partial opacity, as a share of the short side
COMPOSITES = 25
FIRST_SEED = {"choosing": 0, "reporting": 10_000}


@dataclass(frozen=True)
class Composite:
    """An object over a background.

    Attributes:
        name: names of the two photographs and the shape.
        image: (1, 3, H, W).
        alpha: opacity of the object, (1, 1, H, W).
        object: its colours, (1, 3, H, W).
        background: (1, 3, H, W).
    """

    name: str
    image: Tensor
    alpha: Tensor
    object: Tensor
    background: Tensor

    def scribbles(self, count: int, seed: int) -> tuple[Tensor, Tensor]:
        """Draw masks (1, 1, H, W) of ``count`` short strokes inside the object, and as many in the background."""
        random = np.random.default_rng(seed)
        alpha = self.alpha[0, 0].numpy()
        inside, outside = (draw_strokes(place, count, random) for place in (alpha > 0.98, alpha < 0.02))
        return inside, outside

    def trimap(self) -> tuple[Tensor, Tensor]:
        """Masks (1, 1, H, W) of the object and of the background, but for a wide band around partial opacity."""
        alpha = self.alpha[0, 0].numpy()
        soft = (alpha > 0.01) & (alpha < 0.99)
        border = cv2.morphologyEx((alpha > 0.5).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
        radius = round(BAND * min(alpha.shape))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        known = cv2.dilate((soft | border).astype(np.uint8), disc) == 0
        inside, outside = (torch.from_numpy(known & side)[None, None].float() for side in (alpha > 0.5, alpha <= 0.5))
        return inside, outside


def draw_strokes(allowed: NDArray[np.bool_], count: int, random: np.random.Generator) -> Tensor:
    """Draw a mask (1, 1, H, W) of short strokes, spread over an area and away from its border where possible."""
    short = min(allowed.shape)
    depth = cv2.distanceTransform(np.pad(allowed, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    places = np.argwhere(depth >= min(depth.max(), 2 * RADIUS * short))
    drawn, middles = np.zeros(allowed.shape, np.uint8), np.zeros((0, 2))
    for _ in range(count):
        options = places[random.integers(len(places), size=6)]
        apart = np.linalg.norm(options[:, None] - middles[None], axis=2).min(1) if len(middles) else 0.0
        middle = options[np.argmax(depth[tuple(options.T)] + apart)]
        angle, length = random.uniform(0, np.pi), LENGTH * short
        step = 0.5 * length * np.array([np.sin(angle), np.cos(angle)])
        line = np.zeros(allowed.shape, np.uint8)
        ends = [tuple(int(v) for v in np.round(middle + sign * step)[::-1]) for sign in (-1, 1)]
        cv2.line(line, ends[0], ends[1], 1, max(1, round(2 * RADIUS * short)))
        line[~allowed] = 0
        labels = cv2.connectedComponents(line)[1]
        middles = np.concatenate([middles, middle[None]])
        drawn[labels == labels[tuple(middle)] if labels[tuple(middle)] else line > 0] = 1
        drawn[tuple(middle)] = 1
    return torch.from_numpy(drawn)[None, None].float()


def blob(random: np.random.Generator, size: tuple[int, int], radius: float, middle: tuple[float, float]) -> Plane:
    """Draw an antialiased star-shaped area with a wavy border, (H, W)."""
    scale = 4
    angles = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    reach = np.ones_like(angles)
    for wave in range(2, 7):
        reach += random.normal(0, 0.28 / wave) * np.cos(wave * angles + random.uniform(0, 2 * np.pi))
    reach = radius * np.clip(reach, 0.35, 1.7)
    stretch = random.uniform(0.75, 1.3)
    points = np.stack([middle[1] + stretch * reach * np.cos(angles), middle[0] + reach / stretch * np.sin(angles)], 1)
    drawn = np.zeros((size[0] * scale, size[1] * scale), np.uint8)
    cv2.fillPoly(drawn, [np.round(points * scale).astype(np.int32)], 255)
    return cv2.resize(drawn, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def draw_shape(shape: str, random: np.random.Generator, size: tuple[int, int]) -> Plane:
    """Draw the opacity (H, W) of an object."""
    height, width = size
    middle = (height * random.uniform(0.42, 0.58), width * random.uniform(0.38, 0.62))
    radius = height * random.uniform(0.24, 0.34)
    alpha = blob(random, size, radius, middle)
    if shape == "holes":
        for _ in range(random.integers(1, 4)):
            angle, away = random.uniform(0, 2 * np.pi), random.uniform(0.1, 0.6) * radius
            at = (middle[0] + away * np.sin(angle), middle[1] + away * np.cos(angle))
            alpha = alpha * (1 - blob(random, size, radius * random.uniform(0.15, 0.3), at))
    if shape == "hairs":
        scale, hairs = 4, np.zeros((height * 4, width * 4), np.uint8)
        for _ in range(90):
            angle, bend = random.uniform(0, 2 * np.pi), random.normal(0, 0.6)
            along = np.linspace(0.4, random.uniform(1.15, 1.6), 24)
            turned = angle + bend * (along - 0.4)
            points = np.stack(
                [middle[1] + radius * along * np.cos(turned), middle[0] + radius * along * np.sin(turned)]
            )
            cv2.polylines(hairs, [np.round(points.T * scale).astype(np.int32)], False, 255, random.integers(2, 6))
        alpha = np.maximum(alpha, cv2.resize(hairs, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255)
    if shape == "motion":
        length, angle = int(height * random.uniform(0.08, 0.16)) | 1, random.uniform(0, np.pi)
        kernel, half = np.zeros((length, length), np.float32), length // 2
        step = (round(half * np.cos(angle)), round(half * np.sin(angle)))
        cv2.line(kernel, (half - step[0], half - step[1]), (half + step[0], half + step[1]), 1.0, 1)
        alpha = cv2.filter2D(alpha, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    if shape == "soft":
        alpha = cv2.GaussianBlur(alpha, (0, 0), height * random.uniform(0.012, 0.03))
    return alpha.clip(0, 1)


def crop(image: Tensor, share: tuple[float, float], random: np.random.Generator, size: tuple[int, int]) -> Tensor:
    """Cut a part of random size and position from a photograph (1, 3, H, W), and resize it to ``size``."""
    height, width = image.shape[-2:]
    scale = random.uniform(*share) * min(height / size[0], width / size[1])
    rows, columns = int(size[0] * scale), int(size[1] * scale)
    top, left = random.integers(height - rows + 1), random.integers(width - columns + 1)
    part = image[0, :, top : top + rows, left : left + columns].permute(1, 2, 0).numpy()
    method = cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC
    return torch.from_numpy(cv2.resize(part, size[::-1], interpolation=method)).permute(2, 0, 1)[None].clamp(0, 1)


def composites(count: int, first_seed: int, images: dict[str, Tensor], size: tuple[int, int]) -> Iterator[Composite]:
    """Yield ``count`` composites, each reproducible from its seed."""
    names = sorted(images)
    for seed in range(first_seed, first_seed + count):
        random = np.random.default_rng(seed)
        front, back = (names[i] for i in random.choice(len(names), 2, replace=False))
        shape = SHAPES[seed % len(SHAPES)]
        alpha = torch.from_numpy(draw_shape(shape, random, size))[None, None]
        thing, behind = crop(images[front], (0.3, 0.6), random, size), crop(images[back], (0.6, 1.0), random, size)
        mixed = alpha * thing + (1 - alpha) * behind
        noise = torch.from_numpy(random.normal(0, 1.5 / 255, mixed.shape).astype(np.float32))
        yield Composite(f"{front} on {back}, {shape}", (mixed + noise).clamp(0, 1), alpha, thing, behind)


def sources(folder: Path | None, kind: str) -> dict[str, Tensor]:
    """Photographs for composites: those in a folder, or scikit-image's of one of the two sets."""
    if folder is not None:
        return pictures(folder, 426, ())
    names = CHOOSING if kind == "choosing" else REPORTING
    return {name: photograph(name)[:, :3].expand(-1, 3, -1, -1) for name in names}


@dataclass(frozen=True)
class Setup:
    """What a benchmark on composites is asked for: their number, size (H, W), photographs, first seed, and set."""

    count: int
    size: tuple[int, int]
    images: dict[str, Tensor]
    first: int
    kind: str
    quick: bool


def setup(name: str, description: str | None, arguments: list[str] | None) -> Setup:
    """Read the options of the command line of a benchmark."""
    parser = options(name, description, "one composite of 40x56")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of photographs; default: those of scikit-image")
    add("--set", choices=tuple(FIRST_SEED), default="reporting", help="which photographs and seeds")
    add("--first-seed", type=int, help="first seed of composites and scribbles; default: that of the set")
    add("--composites", type=int, default=COMPOSITES, help="number of composites")
    chosen = parser.parse_args(arguments)
    count, size = (1, (40, 56)) if chosen.quick else (chosen.composites, SIZE)
    first = FIRST_SEED[chosen.set] if chosen.first_seed is None else chosen.first_seed
    return Setup(count, size, sources(chosen.pictures, chosen.set), first, chosen.set, chosen.quick)
