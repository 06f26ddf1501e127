"""This program's edits of brightness as functions of a few parameters, at some pixels of a picture.

All that takes time depends on the picture alone: the filter, its layers, the unsharp mask, the variance around a pixel.
It is computed once, see :class:`Ingredients`. After that the edits are pointwise, and a sample of the pixels says what
parameters do, in milliseconds: also the means of the picture, which limits of brightness keep, are those of the sample.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, cast

import torch
from torch import Tensor

from nlfilter_torch.core.inner import EVERYWHERE, Inner
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.operator.build import sampled_operator
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.photo.declared.declaration import GAINS
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.presets import PRESETS
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import edit_of
from nlfilter_torch.photo.edits.detail import Detail, DetailChange
from nlfilter_torch.photo.edits.noise import noise_of
from nlfilter_torch.photo.edits.sharpen import UNIT, Sharpen, UnsharpMask
from nlfilter_torch.photo.edits.synthesis import Polynomial
from nlfilter_torch.photo.edits.tone import Tone
from nlfilter_torch.photo.picture.changes import activity, limit_by_activity
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.pixels import Fitted, part_of
from nlfilter_torch.photo.picture.source import luminance, seeded
from nlfilter_torch.photo.picture.viewing import within_limits

LEVELS = 255.0
USUAL_THRESHOLD: float = Step("detail")["threshold"]  # in levels
USUAL_AMOUNT: float = Step("sharpen")["amount"]
MOST_LEVELS = 60.0  # largest threshold of detail that is looked for

Key = tuple[str, tuple[tuple[str, Value], ...]]  # name and filter of an edit


@dataclass(frozen=True, eq=False)
class Ingredients:
    """What an edit needs to know of some pixels.

    Attributes:
        image: (1, C, h, w).
        layers: that the edit adds, (1, K, 1, h, w).
        activity: variance of luminance around the pixels, (1, 1, h, w).
        weights: how much the pixels count in means, (1, 1, h, w); None is 1 each.
    """

    image: Tensor
    layers: Tensor
    activity: Tensor
    weights: Tensor | None = None

    def at(self, places: Tensor) -> "Ingredients":
        """Those of single pixels, given by row-major indices (P,), as a picture of one row, in float64.

        The pixels are weighted so that their means of what the edit may change are those of the picture.
        """
        planes = (planes.flatten(-2)[..., None, places].double() for planes in (self.image, self.layers, self.activity))
        whole, sample = self._measured(), Ingredients(*planes)
        columns = sample._measured()
        missing = whole.mean(1) - columns.mean(1)
        gram = columns @ columns.mT / columns.shape[1]
        gram = gram + 1e-9 * torch.diag(gram.diagonal()) + 1e-12 * torch.eye(len(gram), dtype=gram.dtype)
        weights = (1 + torch.linalg.solve(gram, missing) @ columns).clamp(min=0.5, max=2.0)
        return replace(sample, weights=(weights / weights.max()).view(1, 1, 1, -1))

    def _measured(self) -> Tensor:
        """What has the means of the picture, (S, P), in float64."""
        grey, layers = reduce_channels(self.image, "luminance"), self.layers[0]
        shares = self.activity / (self.activity + (USUAL_THRESHOLD / LEVELS) ** 2)
        planes = [torch.ones_like(grey), grey, grey.square(), layers.transpose(0, 1), (layers * shares).transpose(0, 1)]
        return torch.cat([part[0].flatten(1).double() for part in planes])

    def every(self, step: int) -> "Ingredients":
        """Those of each ``step``-th column."""
        weights = None if self.weights is None else self.weights[..., ::step]
        return Ingredients(self.image[..., ::step], self.layers[..., ::step], self.activity[..., ::step], weights)


@dataclass(frozen=True, kw_only=True)
class OwnEdit(ABC):
    """An edit whose parameters are to be found.

    Attributes:
        edit: its name.
        has_layers: whether its filter gives layers of detail, which others with the same parameters share.
        limits: of brightness.
        filter: parameters of its filter that are not the defaults.
        viewing_size: of the step.
    """

    edit: ClassVar[str]
    has_layers: ClassVar[bool] = True
    limits: Limits = "soft"
    filter: tuple[tuple[str, Value], ...] = ()
    viewing_size: float = Step("detail")["viewing_size"]

    @property
    @abstractmethod
    def start(self) -> tuple[float, ...]:
        """Values to start from."""

    @property
    @abstractmethod
    def ends(self) -> tuple[tuple[float, float], ...]:
        """Range of each value."""

    @property
    @abstractmethod
    def idle(self) -> tuple[float, ...]:
        """Values that change nothing."""

    @property
    @abstractmethod
    def usual(self) -> tuple[tuple[float, ...], ...]:
        """For each value, what it often is."""

    @abstractmethod
    def parameters(self, values: Sequence[float]) -> dict[str, Value]:
        """Parameters of the step with these values."""

    @abstractmethod
    def layers(self, image: Tensor, operator: NonlocalOperator) -> Tensor:
        """The layers (1, K, 1, h, w) that the edit adds to an image (1, C, h, w), with its filter."""

    @abstractmethod
    def edited(self, seen: Ingredients, values: Tensor) -> Tensor:
        """The edited pixels (1, C, h, w)."""

    @property
    def known(self) -> tuple[tuple[float, ...], ...]:
        """Values of presets."""
        return ()

    @property
    def key(self) -> Key:
        """What :class:`Ingredients` depend on."""
        return self.edit, self.filter

    def step(self, values: Sequence[float]) -> Step:
        """The step with these values."""
        common: dict[str, Value] = {"limits": self.limits, "viewing_size": self.viewing_size, **dict(self.filter)}
        return Step(self.edit, (), **common, **self.parameters(values))

    def operator(self, source: InMemory) -> NonlocalOperator:
        """The filter of a picture at the viewing size."""
        edit = cast(Detail | Tone | Sharpen, edit_of(self.step(self.start), source.size))
        return source.operator(edit.guide(source.size)).operator

    def roughly(self, image: Tensor, places: Tensor) -> Ingredients:
        """:meth:`Ingredients.at` pixels (P,) that are spread evenly, with a filter that is balanced over them alone.

        It takes a fifth of the time of megapixels, and layers are off by a twentieth. Not for :class:`OwnSharpen`.
        """
        size = (image.shape[2], image.shape[3])
        options, grey = self.step(self.start).filter_options(size), reduce_channels(image, "luminance")
        options["num_landmarks"] = min(options["num_landmarks"], image.shape[2] * image.shape[3])
        operator = sampled_operator(grey, places, **options, generator=seeded())
        pixels, variance = (planes.flatten(2)[..., None, places] for planes in (image, activity(image)))
        layers = self.layers(pixels, operator)
        return Ingredients(pixels.double(), layers.double(), variance.double())

    def ingredients(self, image: Tensor, operator: NonlocalOperator) -> Ingredients:
        """What the edit needs to know of an image (1, C, h, w), with its filter."""
        return Ingredients(image, self.layers(image, operator), activity(image))


@dataclass(frozen=True, kw_only=True)
class OwnDetail(OwnEdit):
    """Detail sliders and a threshold."""

    edit: ClassVar[str] = "detail"
    order: int = 3

    @property
    def start(self) -> tuple[float, ...]:
        """Sliders, and the threshold in levels."""
        return (*(1.5,) * self.order, 1.0, USUAL_THRESHOLD)

    @property
    def ends(self) -> tuple[tuple[float, float], ...]:
        """Range of sliders, and of the threshold."""
        return (*(GAINS,) * (self.order + 1), (0.0, MOST_LEVELS))

    @property
    def idle(self) -> tuple[float, ...]:
        """Sliders of 1; the default threshold."""
        return (*(1.0,) * (self.order + 1), USUAL_THRESHOLD)

    @property
    def usual(self) -> tuple[tuple[float, ...], ...]:
        """The last slider is 1; the threshold is the default or 0."""
        return (*((),) * self.order, (1.0,), (USUAL_THRESHOLD, 0.0))

    @property
    def known(self) -> tuple[tuple[float, ...], ...]:
        """Sliders of presets with the default filter, and the default threshold."""
        steps = [recipe.steps[0] for recipe in PRESETS.values()]
        plain = [step["alpha"] for step in steps if {name for name, _ in step.values} <= {"alpha"}]
        return tuple((*alpha, USUAL_THRESHOLD) for alpha in plain if len(alpha) == self.order + 1)

    def parameters(self, values: Sequence[float]) -> dict[str, Value]:
        """Sliders and threshold."""
        return {"alpha": tuple(values[:-1]), "threshold": float(values[-1])}

    def layers(self, image: Tensor, operator: NonlocalOperator) -> Tensor:
        """Detail layers of luminance."""
        return detail_layers(operator, reduce_channels(image, "luminance"), order=self.order)

    def edited(self, seen: Ingredients, values: Tensor) -> Tensor:
        """Pixels under sliders and threshold."""
        sliders = values[:-1] - 1
        change = DetailChange(Polynomial(luminance, part_of(seen.layers)), sliders)
        fitted = Fitted(change, LimitedAt(seen.activity, float(values[-1]) / LEVELS))
        return _all(seen, fitted, self.limits, sliders[-1].reshape(1, 1, 1, 1))


@dataclass(frozen=True, kw_only=True)
class OwnTone(OwnEdit):
    """Contrast and clarity."""

    edit: ClassVar[str] = "tone"

    @property
    def start(self) -> tuple[float, ...]:
        """Contrast and clarity."""
        return (1.2, 1.2)

    @property
    def ends(self) -> tuple[tuple[float, float], ...]:
        """Range of gains."""
        return (GAINS, GAINS)

    @property
    def idle(self) -> tuple[float, ...]:
        """Gains of 1."""
        return (1.0, 1.0)

    @property
    def usual(self) -> tuple[tuple[float, ...], ...]:
        """Gains of 1."""
        return ((1.0,), (1.0,))

    def parameters(self, values: Sequence[float]) -> dict[str, Value]:
        """Contrast and clarity."""
        return {"contrast": float(values[0]), "clarity": float(values[1])}

    def layers(self, image: Tensor, operator: NonlocalOperator) -> Tensor:
        """The two coarsest layers of luminance less its mean."""
        grey = reduce_channels(image, "luminance")
        return detail_layers(operator, grey - grey.mean(), order=3)[:, -2:]

    def edited(self, seen: Ingredients, values: Tensor) -> Tensor:
        """Pixels under contrast and clarity."""
        change = ((values.flip(0) - 1).view(1, 2, 1, 1, 1) * seen.layers).sum(1)
        return _all(seen, Fitted(part_of(change)), self.limits, 0.0)


@dataclass(frozen=True, kw_only=True)
class OwnSharpen(OwnEdit):
    """The amount of sharpening."""

    edit: ClassVar[str] = "sharpen"
    has_layers: ClassVar[bool] = False

    @property
    def start(self) -> tuple[float, ...]:
        """The amount."""
        return (3.0,)

    @property
    def ends(self) -> tuple[tuple[float, float], ...]:
        """Range of gains."""
        return (GAINS,)

    @property
    def idle(self) -> tuple[float, ...]:
        """An amount of 1."""
        return (1.0,)

    @property
    def usual(self) -> tuple[tuple[float, ...], ...]:
        """The default amount."""
        return ((USUAL_AMOUNT,),)

    def parameters(self, values: Sequence[float]) -> dict[str, Value]:
        """The amount."""
        return {"amount": float(values[0])}

    def layers(self, image: Tensor, operator: NonlocalOperator) -> Tensor:
        """The unsharp mask."""
        layers = detail_layers(operator, reduce_channels(image, "luminance"), order=1)
        noise = noise_of(InMemory(image), "luminance")
        strength = torch.ones(1, 1, 1, 1, dtype=image.dtype)
        return UnsharpMask(noise, strength)(image, layers.flatten(1, 2), EVERYWHERE).unsqueeze(1)

    def edited(self, seen: Ingredients, values: Tensor) -> Tensor:
        """Pixels under an amount."""
        change = (values[0] - 1) / UNIT * seen.layers[:, 0]
        return _all(seen, Fitted(part_of(change)), self.limits, 0.0)


@dataclass(frozen=True, eq=False)
class LimitedAt:
    """:func:`limit_by_activity` for a variance (1, 1, h, w) that is known."""

    activity: Tensor
    threshold: float

    def __call__(self, image: Tensor, changes: Tensor, _: Inner) -> Tensor:
        """Added detail and the rest, summed, (1, 1, h, w)."""
        return limit_by_activity(changes, self.activity, self.threshold)


def _all(seen: Ingredients, change: Fitted, limits: Limits, brighter: float | Tensor) -> Tensor:
    """All pixels under a change of brightness."""
    source = InMemory(seen.image, weights=seen.weights)
    return source.all(within_limits(source, change, limits, brighter))
