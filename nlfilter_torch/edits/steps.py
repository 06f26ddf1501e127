"""The steps of a whole edit, as an editor has them: sliders, strokes and settings, all of them relative to the picture.

Each is a value: nothing in it depends on the photograph, so that one that was made on a preview holds for the original.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from nlfilter_torch.edits.abstract import Abstraction
from nlfilter_torch.edits.colorize import Colorization
from nlfilter_torch.edits.colour import edit_luminance
from nlfilter_torch.edits.defocus import Defocusing
from nlfilter_torch.edits.detail import colour_masks
from nlfilter_torch.edits.presets import ENTRIES, Preset, is_count, is_sliders, is_within
from nlfilter_torch.edits.recolor import Recoloring
from nlfilter_torch.edits.scribbles import Stroke, coloured, mask_of, paint, painted
from nlfilter_torch.filtering.filters import detail_layers, weigh_layers
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import reduce_channels

Valid = tuple[str, Callable[[Any], bool]]  # what an entry must be, in words and as a test

NONE = (1.0, 1.0, 1.0, 1.0)  # sliders that change nothing


def seeded() -> torch.Generator:
    """The randomness that the command line starts with."""
    return torch.Generator().manual_seed(0)


def _within(low: float, high: float) -> Valid:
    return f"a number from {low:g} to {high:g}", lambda value: is_within(value, low, high)


class Step(Protocol):
    """One step of an edit."""

    VALID: ClassVar[dict[str, Valid]]
    PAINTS: ClassVar[tuple[str, ...]]

    @property
    def strokes(self) -> tuple[Stroke, ...]:
        """What is painted for it."""
        ...

    def changes(self) -> bool:
        """Whether it does anything."""
        ...

    def apply(self, image: Tensor) -> Tensor:
        """The edited image, from (1, C, H, W) in [0, 1]."""
        ...


class FilterStep(Step):
    """A step whose filter serves any other of its kind as well, as long as they :meth:`share` it."""

    def share(self) -> tuple[object, ...]:
        """The settings, if any, that the filter depends on beside the image."""
        return ()

    @abstractmethod
    def hold(self, image: Tensor) -> Callable[[Any], Tensor]:
        """What steps that share the filter make of an image (1, C, H, W); the first of them makes it."""

    def apply(self, image: Tensor) -> Tensor:
        """The edited image, from (1, C, H, W) in [0, 1]."""
        return self.hold(image)(self)


@dataclass(frozen=True)
class Detail:
    """Detail sliders, and others inside what looks like the strokes.

    Attributes:
        alpha: sliders, fine to coarse, outside of the region, and everywhere if there is none.
        inside: sliders inside the region, as many.
        spread: how far the region reaches to what is less like the strokes.
        strokes: painted ``in`` for the region's likes, ``out`` for what is to stay outside.
        bandwidth: and what follows, as :class:`Preset` has them.
    """

    alpha: tuple[float, ...] = NONE
    inside: tuple[float, ...] = NONE
    spread: float = 1.0
    strokes: tuple[Stroke, ...] = ()
    bandwidth: float | str = "auto"
    spatial_bandwidth: float | None = None
    patch_size: int = 5
    landmarks: int = 100
    sampling: str = "kmeans"

    PAINTS: ClassVar[tuple[str, ...]] = ("in", "out")
    VALID: ClassVar[dict[str, Valid]] = ENTRIES | {
        "inside": (
            "a list of as many numbers as alpha",
            is_sliders,
        ),
        "spread": _within(0.05, 20),
    }

    @staticmethod
    def of(preset: Preset) -> "Detail":
        """The sliders of a preset, for the whole photograph."""
        return Detail(**asdict(preset), inside=(1.0,) * len(preset.alpha))

    @property
    def preset(self) -> Preset:
        """The sliders outside of the region, and the filter."""
        return Preset(**{f.name: getattr(self, f.name) for f in fields(Preset)})

    def has_region(self) -> bool:
        """Whether sliders of their own count somewhere."""
        return bool(painted(self.strokes, "in"))

    def changes(self) -> bool:
        """Whether it does anything."""
        return any(a != 1 for a in (*self.alpha, *(self.inside if self.has_region() else ())))

    def regions(self, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
        """What is painted as in and as out, (1, 1, H, W); None for nothing out."""
        inner, outer = (mask_of(painted(self.strokes, word), size) for word in ("in", "out"))
        return inner, outer if bool(outer.any()) else None

    def blend(self, layers: Tensor, mask: Tensor | None) -> Tensor:
        """The layers (1, k+1, C, H, W) weighed by the sliders of every pixel; mask (1, 1, H, W)."""
        outside = weigh_layers(layers, torch.tensor(self.alpha))
        return outside if mask is None else torch.lerp(outside, weigh_layers(layers, torch.tensor(self.inside)), mask)

    def apply(self, image: Tensor) -> Tensor:
        """The edited image, from (1, C, H, W) in [0, 1]."""
        if not self.has_region():
            return self.preset.apply(image, generator=seeded())
        inner, outer = self.regions((image.shape[-2], image.shape[-1]))
        mask = colour_masks(
            image,
            inner,
            negative=outer,
            time=self.spread,
            num_landmarks=self.landmarks,
            spatial_bandwidth=self.spatial_bandwidth,
            generator=seeded(),
        )
        options = self.preset.options()
        operator = nonlocal_operator(reduce_channels(image, "luminance"), **options, generator=seeded())
        order = len(self.alpha) - 1
        return edit_luminance(image, lambda y: self.blend(detail_layers(operator, y, order=order), mask))


@dataclass(frozen=True)
class Colorize(FilterStep):
    """Colours for a grey photograph; a coloured one is taken for grey.

    Attributes:
        strokes: of colour.
        strength: how much colour goes to what resembles no stroke, from 0 to 1.
    """

    strokes: tuple[Stroke, ...] = ()
    strength: float = 1.0

    PAINTS: ClassVar[tuple[str, ...]] = ("colour",)
    VALID: ClassVar[dict[str, Valid]] = {"strength": _within(0, 1)}

    def changes(self) -> bool:
        """Whether it does anything."""
        return bool(self.strokes)

    def hold(self, image: Tensor, *, both: bool = True) -> Callable[["Colorize"], Tensor]:
        """Colours from any strokes for the image; its two filters are there together, or one after the other."""
        held = Colorization(reduce_channels(image, "luminance"), generator=seeded(), hold=both)
        size = (image.shape[-2], image.shape[-1])
        return lambda step: held(*paint(step.strokes, size), strength=step.strength)

    def apply(self, image: Tensor) -> Tensor:
        """The edited image, from (1, C, H, W) in [0, 1]; in the memory of one filter."""
        return self.hold(image, both=False)(self)


@dataclass(frozen=True)
class Recolor(FilterStep):
    """New colours for what looks like the strokes.

    Attributes:
        strokes: of colour, or painted ``keep``: their likes stay as they are.
        reach: how far a colour spreads from what is alike to what is less so, from 0 to 0.999.
        tolerance: how different two colours may be and still count as alike, in units of CIE Lab.
    """

    strokes: tuple[Stroke, ...] = ()
    reach: float = 0.8
    tolerance: float = 12.0

    PAINTS: ClassVar[tuple[str, ...]] = ("colour", "keep")
    VALID: ClassVar[dict[str, Valid]] = {"reach": _within(0, 0.999), "tolerance": _within(1, 100)}

    def changes(self) -> bool:
        """Whether it does anything."""
        return bool(coloured(self.strokes))

    def share(self) -> tuple[object, ...]:
        """The tolerance."""
        return (self.tolerance,)

    def hold(self, image: Tensor) -> Callable[["Recolor"], Tensor]:
        """The image under any strokes."""
        if image.shape[1] != 3:
            raise ValueError("recolor needs a colour photograph, got a grey one; use colorize, which colours grey ones")
        held = Recoloring(image, photometric_bandwidth=self.tolerance / 100, generator=seeded())
        size = (image.shape[-2], image.shape[-1])

        def edit(step: Recolor) -> Tensor:
            keep = mask_of(painted(step.strokes, "keep"), size)
            strokes = paint(coloured(step.strokes), size)
            return held(*strokes, keep=keep if bool(keep.any()) else None, reach=step.reach)

        return edit


@dataclass(frozen=True)
class Defocus(FilterStep):
    """A blur of all but what looks like the strokes, and is near them.

    Attributes:
        strokes: painted ``in`` on what stays sharp.
        radius: of the strongest blur, in hundredths of the short side.
    """

    strokes: tuple[Stroke, ...] = ()
    radius: float = 2.5

    PAINTS: ClassVar[tuple[str, ...]] = ("in",)
    VALID: ClassVar[dict[str, Valid]] = {"radius": _within(0.1, 20)}

    def changes(self) -> bool:
        """Whether it does anything."""
        return bool(self.strokes)

    def hold(self, image: Tensor) -> Callable[["Defocus"], Tensor]:
        """The image with any strokes in focus."""
        held = Defocusing(image, generator=seeded())
        size = (image.shape[-2], image.shape[-1])
        focus = lru_cache(1)(lambda strokes: held.focus(mask_of(strokes, size)))
        return lambda step: held.blur(focus(step.strokes), step.radius / 100 * min(size))


@dataclass(frozen=True)
class Abstract(FilterStep):
    """A painting of the photograph: flat areas, lines along edges, few tones.

    Attributes:
        power: how much detail goes: 0 none, 0.1 all but outlines.
        edges: darkness of lines, from 0 to 1.
        width: of lines, in thousandths of the short side.
        tones: to which brightness is reduced, or None.
    """

    power: float = 0.0
    edges: float = 0.0
    width: float = 2.0
    tones: int | None = None

    PAINTS: ClassVar[tuple[str, ...]] = ()
    VALID: ClassVar[dict[str, Valid]] = {
        "power": _within(0, 10),
        "edges": _within(0, 1),
        "width": _within(0.1, 20),
        "tones": (
            "a whole number from 2 to 64, or null",
            lambda v: v is None or (is_count(v, 64) and v >= 2),
        ),
    }

    @property
    def strokes(self) -> tuple[Stroke, ...]:
        """None: it holds for the whole photograph."""
        return ()

    def changes(self) -> bool:
        """Whether it does anything."""
        return self.power > 0 or self.edges > 0 or self.tones is not None

    def hold(self, image: Tensor) -> Callable[["Abstract"], Tensor]:
        """A painting of the image, of any kind."""
        held, short = Abstraction(image, generator=seeded()), min(image.shape[-2:])

        def edit(step: Abstract) -> Tensor:
            width = max(step.width / 1000 * short, 0.3)
            return held(power=step.power, edges=step.edges, edge_width=width, tones=step.tones)

        return edit
