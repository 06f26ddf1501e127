"""Pictures as image files, strokes and curves as SVG, for the browser."""

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from nlfilter_torch.filtering.filters import polynomial_response
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.strokes import Mark, Point, Region, ScribbleRole, Stroke
from nlfilter_torch.photo.picture.colour import hundredths_of_lab

JPEG_QUALITY = 95
#: Colours of the mask, of which the one that differs most from the picture under it is shown.
TINTS = ((255, 40, 80), (0, 190, 255), (255, 220, 0))
OPACITY = 120  # of the mask, of 255
COMPARED = 4096  # pixels, about, with which these are compared
HATCH_PERIOD = 8  # pixels of a preview from one line to the next
#: Colours of strokes by their roles.
ROLES: dict[ScribbleRole, str] = {
    "object": "#22c55e",
    "background": "#ef4444",
    "added": "#38bdf8",
    "removed": "#a855f7",
    "box": "#f59e0b",
}
KEPT_STROKE = "#9ca3af"  # colour of strokes on what keeps its colour
OUTLINE = 2  # width in pixels of a preview of the border of a region
BAR = 0.15  # half the length of a bar across a gradient, as a share of the short side
WHITE_TINT, BLACK_TINT = (255, 60, 60, 255), (60, 120, 255, 255)  # where a picture is clipped
BINS = 64  # of a histogram


def _bytes(image: Tensor) -> Tensor:
    """An image (1, C, H, W) in [0, 1] as (C, H, W) of 8 bits."""
    return (image[0] * 255).round_().to(torch.uint8)


def _grey_or_rgb(image: Tensor) -> Image.Image:
    """An image (1, 1 or 3, H, W) in [0, 1] for Pillow."""
    values = _bytes(image)
    planes = values[0] if len(values) == 1 else values.permute(1, 2, 0)
    return Image.fromarray(np.ascontiguousarray(planes.numpy()))


def planes(image: Image.Image) -> Tensor:
    """An image of Pillow, grey or RGB with 8 bits, as (1, 1 or 3, H, W) in [0, 1]."""
    values = torch.from_numpy(np.array(image))
    return (values[None] if values.ndim == 2 else values.permute(2, 0, 1))[None] / 255


def picture(image: Tensor) -> bytes:
    """An image (1, 1 or 3, H, W) in [0, 1] as a JPEG."""
    return _encode(_grey_or_rgb(image), "JPEG", quality=JPEG_QUALITY, subsampling=0)


def lossless(image: Tensor) -> bytes:
    """An image (1, 1 or 3, H, W) in [0, 1] as a PNG."""
    return _encode(_grey_or_rgb(image), "PNG", compress_level=1)


def mask_picture(mask: Tensor, tint: tuple[int, int, int]) -> bytes:
    """A mask (1, 1, H, W) in [0, 1] as a tinted, transparent PNG."""
    alpha = (mask[0, 0] * OPACITY).round().to(torch.uint8).numpy()
    layer = np.empty((*alpha.shape, 4), np.uint8)
    layer[..., :3], layer[..., 3] = tint, alpha
    return _encode(Image.fromarray(layer), "PNG", compress_level=1)


def contrasting_tint(image: Tensor, mask: Tensor) -> tuple[int, int, int]:
    """The tint of :data:`TINTS` that differs most from the colours of an image (1, C, H, W) in a mask (1, 1, H, W).

    >>> contrasting_tint(torch.tensor([0.9, 0.1, 0.2]).view(1, 3, 1, 1), torch.ones(1, 1, 1, 1))
    (0, 190, 255)
    """
    step = max(1, mask.numel() // COMPARED)
    colours, weights = image.expand(-1, 3, -1, -1).flatten(2)[..., ::step], mask.flatten(2)[..., ::step]
    tints = torch.tensor(TINTS).T[None] / 255
    distances = hundredths_of_lab(tints[..., None]) - hundredths_of_lab(colours.float().unsqueeze(2))
    means = (distances.norm(dim=1) * weights).sum(-1)
    return TINTS[int(means.argmax())]


def hatching(places: Tensor) -> bytes:
    """Black and white lines on some pixels (1, 1, H, W), as a transparent PNG."""
    height, width = places.shape[-2:]
    phase = (torch.arange(height).unsqueeze(1) + torch.arange(width)) % HATCH_PERIOD
    lines, values = (places[0, 0] > 0) & (phase < HATCH_PERIOD // 2), torch.where(phase < HATCH_PERIOD // 4, 255, 0)
    layer = torch.where(lines, values, 0).unsqueeze(2).repeat(1, 1, 4)
    layer[..., 3] = torch.where(lines, 255, 0)
    return _encode(Image.fromarray(layer.to(torch.uint8).numpy()), "PNG", compress_level=1)


def clipped_picture(image: Tensor) -> bytes:
    """Where an image (1, C, H, W) is white (red) or black (blue) in a channel, as a transparent PNG."""
    values = _bytes(image)
    layer = np.zeros((*values.shape[1:], 4), np.uint8)
    layer[(values == 0).any(0).numpy()] = BLACK_TINT
    layer[(values == 255).any(0).numpy()] = WHITE_TINT
    return _encode(Image.fromarray(layer), "PNG", compress_level=1)


def clipped_shares(image: Tensor) -> tuple[float, float]:
    """The shares of pixels with a white channel, and of those with a black channel.

    >>> clipped_shares(torch.tensor([1.0, 0.999, 0.5, 0.0]).view(1, 1, 2, 2))
    (0.5, 0.25)
    """
    values = _bytes(image)
    return float((values == 255).any(0).float().mean()), float((values == 0).any(0).float().mean())


def histogram_svg(image: Tensor) -> str:
    """SVG of the histogram of each channel of an image (1, C, H, W), on a scale that a spike does not flatten."""
    values = _bytes(image)
    counts = torch.stack([torch.bincount(plane.flatten().int() * BINS // 256, minlength=BINS) for plane in values])
    shares = counts.float() / values[0].numel()
    top = max(float(shares.flatten().quantile(0.98)), 1e-9)
    colours = ("#ef4444", "#22c55e", "#60a5fa") if len(values) == 3 else ("#cbd5e1",)
    parts = [
        '<svg viewBox="0 0 300 60" class="histogram" role="img" aria-label="histogram" preserveAspectRatio="none">'
    ]
    for colour, bins in zip(colours, shares.tolist(), strict=True):
        places = [(300 * (i + 0.5) / BINS, 60 - 58 * min(share / top, 1)) for i, share in enumerate(bins)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polygon points="0,60 {line} 300,60" fill="{colour}" stroke="{colour}" class="bins" />')
    return "".join([*parts, "</svg>"])


def _encode(image: Image.Image, kind: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format=kind, **options)
    return stream.getvalue()


def keeps(edit: str) -> bool:
    """Whether what is marked as the background of an edit keeps its colour, while objects take others."""
    return any(scribble.kind == "colours" for scribble in EDITS[edit].scribbles) if edit in EDITS else False


def strokes_svg(marks: Iterable[Mark], size: tuple[int, int], *, keeps: bool = False) -> str:
    """Strokes, and the borders of regions, as SVG in pixels of a preview of ``size`` (height, width).

    With ``keeps``, marks on the background are grey, and others have their own colours.

    >>> strokes_svg([Stroke(((0.5, 0.5), (1.0, 0.5)), 0.1, "#ff0000")], (100, 200))
    '<path d="M100.0 50.0L200.0 50.0" stroke="#ff0000" stroke-width="20.0" class="stroke" />'
    """
    height, width = size
    paths = []
    for mark in marks:
        points, end, thickness = mark.outline if isinstance(mark, Region) else mark.points, "Z", float(OUTLINE)
        if isinstance(mark, Stroke):
            points = points if len(points) > 1 else points * 2  # a dot is a line of no length
            end, thickness = "", 2 * mark.radius * min(size)
        line = "L".join(f"{x * width:.1f} {y * height:.1f}" for x, y in points)
        if isinstance(mark, Region) and mark.shape == "linear":
            first, last = ((x * width, y * height) for x, y in points)
            line, end = _axis(first, last, BAR * min(size)), ""
        colour = mark.colour or (KEPT_STROKE if keeps and mark.role == "background" else ROLES[mark.role])
        paths.append(f'<path d="M{line}{end}" stroke="{colour}" stroke-width="{thickness:.1f}" class="stroke" />')
    return "".join(paths)


def _axis(start: Point, end: Point, bar: float) -> str:
    """The axis of a linear gradient, with a bar across where it is 1, and half of one where it is 0."""
    (x0, y0), (x1, y1) = start, end
    length = math.hypot(x1 - x0, y1 - y0) or 1.0
    across, down = (y0 - y1) * bar / length, (x1 - x0) * bar / length
    bars = [(x0 - across, y0 - down), (x0 + across, y0 + down), start, end]
    bars += [(x1 - across / 2, y1 - down / 2), (x1 + across / 2, y1 + down / 2)]
    return "M".join("L".join(f"{x:.1f} {y:.1f}" for x, y in bars[i : i + 2]) for i in (0, 2, 4))


@dataclass(frozen=True)
class Axes:
    """A plot of gains from ``low`` to ``high`` over eigenvalues from 0 to 1, in units of the SVG."""

    low: float
    high: float
    left = 26
    right = 292
    top = 10
    bottom = 112

    def x(self, eigenvalue: float) -> float:
        """Place of an eigenvalue."""
        return self.left + (self.right - self.left) * eigenvalue

    def y(self, gain: float) -> float:
        """Place of a gain."""
        return self.bottom - (self.bottom - self.top) * (gain - self.low) / (self.high - self.low)

    def grid(self) -> list[str]:
        """Lines, with their labels, at 1 and at about five whole gains."""
        parts = []
        for level in _levels(self.low, self.high):
            y, style = self.y(level), "unit" if level == 1 else "grid"
            parts.append(f'<line x1="{self.left}" x2="{self.right}" y1="{y:.1f}" y2="{y:.1f}" class="{style}" />')
            parts.append(f'<text x="{self.left - 4}" y="{y + 3:.1f}" text-anchor="end">{level:g}</text>')
        return parts

    def marks(self, eigenvalues: Sequence[float]) -> list[str]:
        """Marks of eigenvalues below the plot."""
        ends = f'y1="{self.bottom}" y2="{self.bottom + 5}"'
        return [f'<line x1="{self.x(v):.1f}" x2="{self.x(v):.1f}" {ends} class="mark" />' for v in eigenvalues]

    def curve(self, places: Sequence[float], gains: Sequence[float], colour: str) -> str:
        """A line through gains at places."""
        points = " ".join(f"{self.x(v):.1f},{self.y(g):.1f}" for v, g in zip(places, gains, strict=True))
        return f'<polyline points="{points}" stroke="{colour}" class="curve" />'

    def dots(self, places: Sequence[float], gains: Sequence[float], colour: str) -> list[str]:
        """Dots for gains at places."""
        return [
            f'<circle cx="{self.x(v):.1f}" cy="{self.y(g):.1f}" r="1.6" fill="{colour}" />'
            for v, g in zip(places, gains, strict=True)
        ]


def response_svg(eigenvalues: Tensor, curves: Sequence[tuple[str, Sequence[float]]]) -> str:
    """SVG of the gain f(lambda) of the sliders, with the eigenvalues (R,) marked; curves are (colour, sliders)."""
    steps = torch.linspace(0, 1, 101)
    gains = [polynomial_response(steps, torch.tensor(tuple(alpha))).tolist() for _, alpha in curves]
    axes = Axes(min(0.0, *(min(gain) for gain in gains)), max(2.0, *(max(gain) for gain in gains)))
    parts = ['<svg viewBox="0 0 300 142" class="response" role="img" aria-label="response of the sliders">']
    parts += axes.grid() + axes.marks(eigenvalues.tolist())
    for (colour, alpha), gain in zip(curves, gains, strict=True):
        parts.append(axes.curve(steps.tolist(), gain, colour))
        at_eigenvalues = polynomial_response(eigenvalues, torch.tensor(tuple(alpha))).tolist()
        parts += axes.dots(eigenvalues.tolist(), at_eigenvalues, colour)
    parts.append(f'<text x="{axes.left}" y="130">texture, \u03bb = 0</text>')
    parts.append(f'<text x="{axes.right}" y="130" text-anchor="end">shading, \u03bb = 1</text></svg>')
    return "".join(parts)


def _levels(low: float, high: float) -> list[float]:
    """Gains at which to draw lines: 1 and about five whole numbers."""
    step = max(1, round((high - low) / 5))
    return sorted({float(v) for v in range(int(low) - 1, int(high) + 1) if v >= low and v % step == 0} | {1.0})
