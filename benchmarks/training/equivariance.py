"""Results for pictures that are flipped, transposed or rotated by 90 degrees, beside results turned afterwards.

The layer of ``NonlocalFilter(alpha=(3, 1))`` at h = 20/255 with M = 100 landmarks, on 128x128 pixels, masks, and every
edit but ``denoise``, on pictures of odd height and width. Nothing was chosen on these pictures.
"""

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from benchmarks.photographs import photograph
from benchmarks.training.figures import Figure
from nlfilter_torch import NonlocalFilter, SegmentMask, diffusion_mask, nonlocal_operator, refine
from nlfilter_torch.photo import (
    abstract,
    adjust_tone,
    apply_look,
    colorize,
    defocus,
    enhance,
    filter_frames,
    recolor,
    region_mask,
    sharpen,
)
from tests.problems import inverse, oriented

LIMIT, LEVELS = 0.05, 255
ORIENTATIONS = range(1, 8)  # all others, see tests.problems.oriented
PICTURES = ("chelsea", "coffee", "rocket")
EDITED = "astronaut"
SIZES = ((127, 171), (301, 397))  # of the pictures that are edited; larger ones are reduced within some edits
Edit = Callable[..., Tensor]


def differences(edit: Edit, planes: list[Tensor], numbers: range) -> Tensor:
    """Differences in grey levels, of all pixels, between results for turned planes and turned results."""
    with torch.no_grad():
        expected = edit(*planes)
        results = [inverse(edit(*(oriented(part, number) for part in planes)), number) for number in numbers]
    return torch.stack([(result - expected).abs().flatten() for result in results]).flatten() * LEVELS


def spots(size: tuple[int, int], *corners: tuple[float, float]) -> Tensor:
    """A mask (1, 1, H, W) of rectangles with their corners at shares of the size."""
    mask = torch.zeros(1, 1, *size)
    height, width = size
    for row, column in corners:
        top, left = int(row * height), int(column * width)
        mask[:, :, top : top + height // 7, left : left + width // 9] = 1
    return mask


def strokes(image: Tensor, mask: Tensor) -> Tensor:
    """Colours (1, 3, H, W) under a mask: those of the picture with its channels exchanged."""
    return image.flip(1) * mask


def mask_of(image: Tensor, region: Tensor) -> Tensor:
    """A diffusion mask."""
    return diffusion_mask(nonlocal_operator(image, photometric_bandwidth=0.1).spectrum(), region)


def classes_of(image: Tensor, regions: Tensor, temperature: float = 0.0) -> Tensor:
    """Masks of segments."""
    layer = SegmentMask(temperature=temperature)
    return layer(nonlocal_operator(image, photometric_bandwidth=0.1).spectrum(), regions)


def edits(image: Tensor) -> dict[str, tuple[Edit, list[Tensor]]]:
    """Masks and edits, with the planes that turn."""
    size = (image.shape[2], image.shape[3])
    front, back = spots(size, (0.35, 0.4), (0.55, 0.3)), spots(size, (0.05, 0.8), (0.8, 0.1))
    paint = strokes(image, front + back)
    grey = image.mean(1, keepdim=True)
    alpha = torch.tensor([2.0, 1.5, 1.0])
    look = partial(apply_look, alpha=(1.5, 1.2, 1.0), bands=(1.2,) * 7, stretch=(0.5, 0.2, 0.2), local=(0.1,) * 8)
    return {
        "diffusion_mask": (mask_of, [image, front]),
        "SegmentMask": (classes_of, [image, torch.cat([front, back], dim=1)]),
        "SegmentMask with a temperature": (
            partial(classes_of, temperature=0.3),
            [image, torch.cat([front, back], dim=1)],
        ),
        "refine": (lambda picture, mask: refine(0.3 + 0.4 * mask, picture), [image, front]),
        "region_mask": (region_mask, [image, front]),
        "region_mask with a background": (region_mask, [image, front, back]),
        "enhance": (lambda picture: enhance(picture, alpha), [image]),
        "enhance with masks": (
            lambda picture, mask: enhance(picture, torch.stack([alpha, alpha.flip(0)]), regions=mask),
            [image, torch.cat([front, back], dim=1)],
        ),
        "sharpen": (lambda picture: sharpen(picture, amount=3.0), [image]),
        "adjust_tone": (lambda picture: adjust_tone(picture, contrast=1.3, clarity=2.0), [image]),
        "abstract": (lambda picture: abstract(picture, tones=6, edges=0.5), [image]),
        "apply_look": (look, [image]),
        "filter_frames": (lambda *frames: next(filter_frames(frames, alpha, references=frames[1:])), [image, image**2]),
        "recolor": (recolor, [image, paint * front, front]),
        "recolor with keep": (
            lambda *planes: recolor(*planes[:3], keep=planes[3]),
            [image, paint * front, front, back],
        ),
        "colorize": (colorize, [grey, paint, front + back]),
        "colorize by kmeans": (partial(colorize, method="kmeans"), [grey, paint, front + back]),
        "defocus": (defocus, [image, front]),
    }


def of_layers(numbers: range) -> Iterator[Figure]:
    """Figures of the layer."""
    for name, options in (("without a spatial term", {}), ("with h_x = 20 pixels", {"spatial_bandwidth": 20.0})):
        layer = NonlocalFilter(alpha=(3, 1), photometric_bandwidth=20 / 255, num_landmarks=100, **options)
        parts = [
            differences(layer, [photograph(picture, 128, 128).mean(1, keepdim=True)], numbers) for picture in PICTURES
        ]
        levels = torch.cat(parts)
        yield Figure(f"layer {name}: mean", levels.mean().item(), LIMIT, "levels")
        yield Figure(f"layer {name}: 99th percentile", levels.double().quantile(0.99).item(), LIMIT, "levels")
        yield Figure(f"layer {name}: most", levels.max().item(), LIMIT, "levels")


def measure(*, quick: bool) -> Iterator[Figure]:
    """Measure layers, masks and edits."""
    numbers = range(5, 6) if quick else ORIENTATIONS
    yield from of_layers(numbers)
    for size in SIZES[:1] if quick else SIZES:
        image = photograph(EDITED, *size)
        for name, (edit, planes) in edits(image).items():
            levels = differences(edit, planes, numbers if size == SIZES[0] else range(5, 7))
            yield Figure(f"{name} at {size[0]}x{size[1]}: most", levels.max().item(), LIMIT, "levels")
