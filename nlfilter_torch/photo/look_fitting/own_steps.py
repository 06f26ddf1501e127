"""Steps of this program, with their parameters, from pairs of photographs before and after an edit.

A look imitates an edit; if this program made it, the steps themselves explain more of it, and suit other photographs.
Looked for are detail with its threshold, tone and sharpening, each with soft limits and with none.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_order
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_recipe
from nlfilter_torch.photo.look_fitting.alignment import inside_frame
from nlfilter_torch.photo.look_fitting.fit_look import FILTER_NAMES, Pair, images_of
from nlfilter_torch.photo.look_fitting.kept_pixels import squares
from nlfilter_torch.photo.look_fitting.look_sums import sample
from nlfilter_torch.photo.look_fitting.own_edits import Ingredients, OwnDetail, OwnEdit, OwnSharpen, OwnTone
from nlfilter_torch.photo.look_fitting.parameter_fit import Minimum, minimize, rounded
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.seen import range_of
from nlfilter_torch.photo.picture.viewing import viewed_size

MOST_PAIRS = 4  # that are looked at; the first ones
COARSE = 4  # of this many pixels of the sample one is looked at first
COARSE_STEPS, FINE_STEPS = 12, 3  # of least squares
# An edit of brightness moves colours along grey, and their chroma in proportion. Shares of a change that must be so,
# and along grey; noise of compression is not.
ALONG_BOTH, ALONG_GREY = 0.6, 0.5
SHADES = 256
CURVE = 0.996  # share that a function of brightness explains from which on an edit counts as a tone curve
NEARLY_ALL = 0.99  # share from which on nothing else is looked for
PROMISING = 0.3  # share that edits by the default filter explain, from which on other filters are looked at


# Steps are preferred to a look if they explain that much of what is left out, and it leaves that many times as much.
ENOUGH, CLEARLY = 0.8, 1.25


@dataclass(frozen=True)
class FittedSteps:
    """Steps that turn photographs into edited ones, and how much of the edits they explain.

    Attributes:
        steps: in their order; none if this program's edits of brightness explain nothing.
        fitted: share of the change of the pairs that they explain, 1 at best.
        left_out: share of the change of pairs, or of parts of a single picture, explained by steps fitted without them.
        explained: the same two for all that was tried, by the names of the edits.
    """

    steps: tuple[Step, ...] = ()
    fitted: float = 0.0
    left_out: float = 0.0
    explained: dict[tuple[str, ...], tuple[float, float]] = field(default_factory=dict)

    def apply(self, image: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """An image (B, C, H, W) in [0, 1] after the steps; values may leave [0, 1]. Differentiable in the image."""
        return apply_recipe(Recipe(self.steps), image, generator=generator)

    def to_json(self) -> str:
        """A file for ``nlfilter-torch apply``: a recipe of the steps."""
        return Recipe(self.steps).to_json(complete=True)

    @property
    def are_nearly_all(self) -> bool:
        """Whether they leave so little that a look cannot explain much more."""
        return self.left_out >= NEARLY_ALL

    def explain_more_than(self, share: float) -> bool:
        """Whether they explain clearly more than a look that explains a share of the change where it is left out."""
        return self.left_out >= ENOUGH and CLEARLY * (1 - self.left_out) < 1 - share


@torch.no_grad()
@full_precision
def fit_steps(pairs: Iterable[Pair], *, order: int = 3, step: Step | None = None) -> FittedSteps:
    """Find the steps of this program, and their parameters, that turn photographs into edited ones.

    Tried are ``detail`` (sliders and threshold, also with the filters of the presets), ``tone`` and ``sharpen``, with
    soft limits and without. The parameters minimise the squared error of the clipped result over 32,768
    pixels of each pair at the viewing size.

    Args:
        pairs: as for :func:`fit_look`, without masks. The first four photographs are looked at.
        order: k; k + 1 sliders of ``detail``.
        step: ``look`` with the parameters of the filter of ``detail`` and ``tone``; None has the defaults.

    Returns:
        The steps that explain most of what was left out of the fit. An edit of colours, or a tone curve, has none.

    Raises:
        TypeError, ValueError: if there is no pair, or the pictures of one do not belong together.

    Example:
        >>> from nlfilter_torch.photo import adjust_tone
        >>> before = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> steps = fit_steps([(before, adjust_tone(before, contrast=1.3).clamp(0, 1))])
        >>> [(step.edit, step["contrast"]) for step in steps.steps]
        [('tone', 1.3)]
    """
    check_order(order)
    search = StepSearch(Step("look") if step is None else step, order)
    for before, after, masks in images_of(pairs):
        if masks is not None:
            raise ValueError("pairs must hold no masks for fit_steps, got some; pass (before, after)")
        search.add(before, after)
    if not search.pairs:
        raise ValueError("pairs must hold a pair of photographs, got none; pass (before, after)")
    return search.fitted()


class ViewedPair:
    """A photograph before and after an edit, at the viewing size, and a sample of its pixels.

    Args:
        before: (C, H, W) in [0, 1].
        after: likewise.
        viewing_size: in megapixels.
        number: of the pair.

    Attributes:
        source: the photograph before the edit, as edits see it.
        places: row-major indices (P,) of the sample.
        before: (1, C, 1, P), in float64.
        after: likewise.
        weights: (P,), 0 in a frame.
        squares: number of the square of each pixel, (P,).
    """

    def __init__(self, before: Tensor, after: Tensor, viewing_size: float, number: int) -> None:
        dtype = working_dtype(before)
        before, after = before.to(dtype), after.to(dtype)
        inside = inside_frame(before, after).to(dtype)
        size = (before.shape[-2], before.shape[-1])
        small = viewed_size(size, viewing_size)
        if small != size:
            inside = (resize(inside[None, None], small)[0, 0] > 0.99).to(dtype)
        working = range_of(InMemory(before[None]))  # of the whole picture
        source, target = InMemory(before[None]).resized(small), resize(after[None], small)
        if working is not None:
            source, target = InMemory(working.seen(source.image)), working.seen(target)
        self.source = InMemory(source.image, {})
        places = sample(torch.ones(small))
        self.places = places[::2] if len(places) < source.size[0] * source.size[1] else places
        self.before, self.after = (
            planes.flatten(2)[..., None, self.places].double() for planes in (source.image, target.clamp(0, 1))
        )
        self.weights = inside.flatten()[self.places].double()
        self.squares = squares(self.places, small[1])
        self.number = number

    def errors(self, edited: Tensor, step: int) -> Tensor:
        """Weighted errors (C P',) of edited pixels (1, C, 1, P'), each ``step``-th of the sample."""
        return ((edited.clamp(0, 1) - self.after[..., ::step]) * self.weights[::step]).flatten()

    def change(self) -> Tensor:
        """The weighted change (C P,)."""
        return ((self.before - self.after) * self.weights).flatten()

    def groups(self, alone: bool) -> Tensor:
        """What is left out together, (C P,): the pair or, if it is the only one, a third of its squares."""
        group = (self.squares + self.squares // 3) % 3 if alone else torch.full_like(self.squares, self.number)
        return group.repeat(self.before.shape[1])

    def is_of_brightness(self) -> bool:
        """Whether the change can be that of an edit of brightness, which depends on the surroundings of pixels."""
        free = ((self.after > 0) & (self.after < 1)).all(1)[0, 0] & (self.weights > 0)
        before, after = self.before[0, :, 0, free], self.after[0, :, 0, free]
        change = after - before
        power = float(change.square().sum())
        if power == 0:
            return False
        if len(change) == 3:
            grey = change.mean(0)
            chroma = before - before.mean(0)
            direction = chroma / chroma.norm(dim=0).clamp(min=1e-6)
            across = change - grey - (change * direction).sum(0) * direction
            along = 3 * float(grey.square().sum())
            if along < ALONG_GREY * power or 1 - float(across.square().sum()) / power < ALONG_BOTH:
                return False
        return _explained_by_curve(before, change) < CURVE


def _explained_by_curve(before: Tensor, change: Tensor) -> float:
    """Share of the change of luminance (C, P) that a function of luminance explains."""
    grey, moved = (reduce_channels(planes[None, :, None], "luminance")[0, 0, 0] for planes in (before, change))
    shades = (grey.clamp(0, 1) * (SHADES - 1)).round().long()
    counts = torch.zeros(SHADES, dtype=grey.dtype).index_add(0, shades, torch.ones_like(grey)).clamp(min=1)
    means = torch.zeros(SHADES, dtype=grey.dtype).index_add(0, shades, moved) / counts
    return 1 - float((moved - means[shades]).square().sum() / moved.square().sum().clamp(min=1e-30))


@dataclass(frozen=True, eq=False)
class Candidate:
    """Edits with the values that suit the pairs best.

    Attributes:
        edits: in their order.
        values: of each.
        fitted: share of the change that they explain.
        left_out: share explained where it was left out of the fit.
    """

    edits: tuple[OwnEdit, ...]
    values: tuple[Tensor, ...]
    fitted: float
    left_out: float

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps."""
        return tuple(edit.step(values.tolist()) for edit, values in zip(self.edits, self.values, strict=True))


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of an edit over samples of pairs, as a function of its values."""

    edit: OwnEdit
    pairs: Sequence[ViewedPair]
    seen: Sequence[Ingredients]
    step: int = 1

    def __call__(self, values: Tensor) -> Tensor:
        """Errors (R,)."""
        edited = (self.edit.edited(seen.every(self.step), values) for seen in self.seen)
        return torch.cat([p.errors(image, self.step) for p, image in zip(self.pairs, edited, strict=True)])


class StepSearch:
    """A search for steps that explain pairs.

    Args:
        step: ``look`` with the parameters of the filter.
        order: of the layers of detail.
    """

    def __init__(self, step: Step, order: int) -> None:
        self.order, self.viewing_size = order, step["viewing_size"]
        names = [name for name in FILTER_NAMES if name != "viewing_size"]
        self.filter = tuple((name, step[name]) for name in names if step[name] != step.declared[name].default)
        self.pairs: list[ViewedPair] = []
        self.candidates: list[Candidate] = []
        self._seen: dict[tuple[object, ...], list[Ingredients]] = {}

    def add(self, before: Tensor, after: Tensor) -> None:
        """Add a photograph (C, H, W) before and after the edit, unless there are enough of them."""
        if len(self.pairs) < MOST_PAIRS:
            self.pairs.append(ViewedPair(before, after, self.viewing_size, len(self.pairs)))

    def watching(self, pairs: Iterable[tuple[Tensor, ...]]) -> Iterator[tuple[Tensor, ...]]:
        """Yield pairs, (B, C, H, W) each, that are added on the way."""
        for before, after, *others in pairs:
            self.add(before[0], after[0])
            yield before, after, *others

    @torch.no_grad()
    @full_precision
    def fitted(self) -> FittedSteps:
        """The steps that explain most."""
        if all(pair.is_of_brightness() for pair in self.pairs):
            self._search()
        explained: dict[tuple[str, ...], tuple[float, float]] = {}
        for candidate in sorted(self.candidates, key=lambda candidate: candidate.left_out):
            explained[tuple(edit.edit for edit in candidate.edits)] = candidate.fitted, candidate.left_out
        best = self._best()
        if best is None or best.left_out <= 0:
            return FittedSteps(explained=explained)
        return FittedSteps(best.steps, best.fitted, best.left_out, explained)

    def _best(self) -> Candidate | None:
        return max(self.candidates, key=lambda candidate: candidate.left_out, default=None)

    def _search(self) -> None:
        """Try edits, those that take least time first, until one explains nearly all."""
        common = {"viewing_size": self.viewing_size}
        self._try(partial(OwnSharpen, **common))
        if self._explained() < NEARLY_ALL:
            self._try(partial(OwnTone, filter=self.filter, **common))
            self._try(partial(OwnDetail, order=self.order, filter=self.filter, **common))
        promising = not self.filter and self._explained() > PROMISING
        for other in filters_of_presets() if promising else []:
            if self._explained() < NEARLY_ALL:
                self._try(partial(OwnDetail, order=self.order, filter=other, **common))

    def _explained(self) -> float:
        best = self._best()
        return 0.0 if best is None else best.left_out

    def _try(self, edit: "partial[OwnSharpen] | partial[OwnTone] | partial[OwnDetail]") -> None:
        """Fit an edit with each kind of limits."""
        for limits in ("soft", "none"):
            self.candidates.append(self._fit(edit(limits=limits)))

    def _fit(self, edit: OwnEdit) -> Candidate:
        """The values of an edit that suit the pairs best, from a coarse sample to a finer one."""
        seen = self._ingredients(edit)
        coarse = minimize(Errors(edit, self.pairs, seen, COARSE), edit.start, edit.ends, COARSE_STEPS)
        errors = Errors(edit, self.pairs, seen)
        fine = minimize(errors, coarse.values.tolist(), edit.ends, FINE_STEPS)
        return self._candidate((edit,), rounded(errors, fine, edit.idle, edit.ends))

    def _candidate(self, edits: tuple[OwnEdit, ...], best: Minimum) -> Candidate:
        groups = torch.cat([pair.groups(len(self.pairs) == 1) for pair in self.pairs])
        power = sum(float(pair.change().square().sum()) for pair in self.pairs)
        left_out = float(best.left_out(groups).square().sum())
        values = best.values.split([len(edit.start) for edit in edits])
        return Candidate(edits, values, 1 - best.loss / power, 1 - left_out / power)

    def _ingredients(self, edit: OwnEdit) -> list[Ingredients]:
        """What an edit needs to know of the samples of all pairs."""
        key = (edit.edit, edit.filter)
        if key not in self._seen:
            self._seen[key] = [
                edit.ingredients(pair.source.image, edit.operator(pair.source)).at(pair.places) for pair in self.pairs
            ]
        return self._seen[key]


def filters_of_presets() -> list[tuple[tuple[str, Value], ...]]:
    """Parameters of the filters of the presets that are not the default ones."""
    filters = [tuple((n, v) for n, v in recipe.steps[0].values if n in FILTER_NAMES) for recipe in PRESETS.values()]
    return [filter for filter in dict.fromkeys(filters) if filter]
