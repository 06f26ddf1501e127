"""How a camera develops a measured picture: tone curve, noise reduction and sharpening.

Shots (2, C, H, W) are the same picture without and with noise. All that depends on the picture is measured on the noisy
shot and done to both; where a function bends (tone curve, limits), the first takes the expected value over the noise.
So the first is close to the mean of many shots, to which noisy photographs are compared.
"""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

#: Means of the standard normal distribution over its six parts of equal probability: where a function has a kink, as at
#: black, the mean of its values there is nearer to the expected value than a rule of Gauss.
NODES = (-1.4991056, -0.6824930, -0.2120550, 0.2120550, 0.6824930, 1.4991056)
ENTRIES = 4096  # of the table by which tone curves are inverted
RADII = 0.7, 1.4, 2.8, 5.6  # pixels; of the scales at which noise in luminance is reduced
WIDEST = 2.0  # pixels; radius up to which a Gaussian is convolved
WINDOW = 9  # side of windows in which the noise is measured


def tone_curve(light: Tensor, contrast: float, shoulder: float) -> Tensor:
    """Map linear light to what a camera writes: sRGB's curve, bent by a soft S, both from 0 to 1.

    Args:
        light: linear, any range; limited to 0 and 1.
        contrast: share of the S-shaped curve, 0 to 1.
        shoulder: exponent of linear light before the curve; less than 1 brightens the shadows.
    """
    light = light.clamp(0, 1) ** shoulder
    encoded = torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)
    return torch.lerp(encoded, encoded.square() * (3 - 2 * encoded), contrast)


def inverse_tone_curve(picture: Tensor, contrast: float, shoulder: float) -> Tensor:
    """Invert :func:`tone_curve`, by linear interpolation in a table."""
    light = torch.linspace(0, 1, ENTRIES, dtype=torch.float64) ** 3  # finer in the shadows
    curve = tone_curve(light, contrast, shoulder)
    values = torch.linspace(0, 1, ENTRIES, dtype=torch.float64)
    upper = torch.searchsorted(curve, values).clamp(1, ENTRIES - 1)
    low, high = curve[upper - 1], curve[upper]
    inverse = torch.lerp(light[upper - 1], light[upper], (values - low) / (high - low)).to(picture)
    places = (ENTRIES - 1) * picture.clamp(0, 1)
    below = places.floor().clamp(max=ENTRIES - 2)
    entries = below.long()
    return torch.lerp(inverse[entries], inverse[entries + 1], places - below)


def expected(function: Callable[[Tensor], Tensor], shots: Tensor, deviation: Tensor | None = None) -> Tensor:
    """A function of the noisy shot, and its expected value over the noise; by default the noise that the shots show."""
    if deviation is None:
        deviation = box((shots[1:] - shots[:1]).square(), WINDOW // 2).clamp(min=0).sqrt()
    mean = sum(function(shots[:1] + node * deviation) for node in NODES) / len(NODES)
    return torch.cat([torch.as_tensor(mean), function(shots[1:])])


def box(planes: Tensor, radius: int) -> Tensor:
    """Means over windows of side ``2 radius + 1``; the picture is mirrored at its borders."""
    side = 2 * radius + 1
    padded = F.pad(planes, (radius, radius, radius, radius), mode="reflect")
    return _sums(_sums(padded, side, -1), side, -2) / side**2


def _sums(values: Tensor, side: int, dim: int) -> Tensor:
    """Sums of ``side`` neighbours, put together from sums of 1, 2, 4, ... values."""
    length = values.shape[dim] - side + 1
    total, start, width = torch.zeros(()), 0, 1
    while width <= side:
        if side & width:
            total = total + values.narrow(dim, start, length)
            start += width
        rest = values.shape[dim] - width
        values = values.narrow(dim, 0, rest) + values.narrow(dim, width, rest)
        width *= 2
    return total


def blurred(planes: Tensor, radius: float) -> Tensor:
    """Blur planes with a Gaussian of a standard deviation in pixels; a wide one is replaced by two boxes."""
    if radius > WIDEST:
        half = round((math.sqrt(6 * radius**2 + 1) - 1) / 2)
        return box(box(planes, half), half)
    reach = max(1, math.ceil(3 * radius))
    weights = [math.exp(-0.5 * (place / radius) ** 2) for place in range(reach + 1)]
    total = weights[0] + 2 * sum(weights[1:])
    planes = F.pad(planes, (reach, reach, reach, reach), mode="reflect")
    for dim in (-1, -2):
        length = planes.shape[dim] - 2 * reach
        mean = weights[0] / total * planes.narrow(dim, reach, length)
        for place in range(1, reach + 1):  # faster than a convolution of single planes
            both = planes.narrow(dim, reach - place, length) + planes.narrow(dim, reach + place, length)
            mean = mean.add(both, alpha=weights[place] / total)
        planes = mean
    return planes


def cored(light: Tensor, strength: float, fall: float, floor: float) -> Tensor:
    """Reduce the noise of a plane (2, 1, H, W): attenuate fine and middling detail where it is not above the noise.

    Args:
        light: plane without and with noise.
        strength: deviation that counts as noise in the finest detail, over the actual one.
        fall: factor of the strength from each scale to the next coarser one.
        floor: smallest gain of detail.
    """
    coarse = light
    for radius in RADII:
        smooth = blurred(coarse, radius)
        detail = coarse - smooth
        noise = (detail[1:] - detail[:1]).square().mean()
        energy = box(detail[1:].square(), 3).clamp(min=1e-12)
        gain = (1 - strength**2 * noise / energy).clamp(min=floor)
        light = light - (1 - gain) * detail
        coarse = smooth
        strength = strength * fall
    return light


def smoothed_colour(planes: Tensor, radius: int, share: float, edges: float) -> Tensor:
    """Smooth Cb and Cr of planes Y, Cb, Cr (2, 3, H, W) by a guided filter, with the noisy luminance as guide.

    Args:
        planes: of both shots.
        radius: of windows in pixels.
        share: of the smoothed colour in the result.
        edges: contrast of the guide from which its edges are kept, over its noise.
    """
    light, colour = planes[:, :1], planes[:, 1:]
    noise = (light[1:] - light[:1]).square().mean()
    guide = light[1:]
    mean = box(guide, radius)
    variance = (box(guide.square(), radius) - mean.square()).clamp(min=0)
    middle = box(colour, radius)
    slope = (box(guide * colour, radius) - mean * middle) / (variance + edges**2 * noise + 1e-6)
    smooth = box(slope, radius) * guide + box(middle - slope * mean, radius)
    return torch.cat([light, torch.lerp(colour, smooth, share)], dim=1)


def median_colour(planes: Tensor, share: float) -> Tensor:
    """Replace a share of Cb and Cr by medians of three, across and then down, every second pixel, of the noisy shot."""
    light, colour = planes[:, :1], planes[:, 1:]
    near = F.pad(colour, (2, 2, 2, 2), mode="reflect")
    for dim in (-1, -2):
        length = near.shape[dim] - 4
        before, middle, after = (near.narrow(dim, start, length) for start in (0, 2, 4))
        is_middle = (before[1] <= middle[1]) == (middle[1] <= after[1])
        is_before = (middle[1] <= before[1]) == (before[1] <= after[1])
        near = torch.where(is_middle, middle, torch.where(is_before, before, after))
    return torch.cat([light, torch.lerp(colour, near, share)], dim=1)


def sharpened(planes: Tensor, amount: float, radius: float) -> Tensor:
    """Unsharp masking of the luminance of planes Y, Cb, Cr."""
    light = planes[:, :1]
    return torch.cat([light + amount * (light - blurred(light, radius)), planes[:, 1:]], dim=1)
