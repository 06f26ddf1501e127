"""Steps of this program, with their parameters, from pairs of photographs before and after an edit.

A look imitates an edit; if this program made it, the steps themselves explain more of it, and suit other photographs.
Looked for are detail with its threshold, tone and sharpening, each with soft limits and with none, and two of them.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from operator import itemgetter

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_order
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_recipe
from nlfilter_torch.photo.look_fitting.fit_look import FILTER_NAMES
from nlfilter_torch.photo.look_fitting.own_chains import Chain, is_exact
from nlfilter_torch.photo.look_fitting.own_edits import Ingredients, Key, OwnDetail, OwnEdit, OwnSharpen, OwnTone
from nlfilter_torch.photo.look_fitting.pairs import Pair, images_of
from nlfilter_torch.photo.look_fitting.parameter_fit import Minimum, minimize, rounded
from nlfilter_torch.photo.look_fitting.viewed_pair import ViewedPair
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import Limits

MOST_PAIRS = 3  # that are looked at; the first ones
COARSE = 4  # the first fits look at one of so many pixels of the sample
COARSE_STEPS, FINE_STEPS = 12, 3  # of least squares
NEARLY_ALL = 0.99  # share from which on nothing else is looked for
LIKELY = 0.97  # share explained by a rough fit from which on steps are fitted before a look, with no other filters
CLOSE = 0.9  # share of a rough fit of one edit from which on it is fitted before two are
PROMISING = 0.3  # share that edits by the default filter explain, from which on other filters are looked at
# Two edits are fitted only if a rough model of them leaves less than this, and than this multiple of what one leaves.
UNPROMISING, LESS = 0.15, 0.6
MORE, RARER = 1.1, 1.01  # what is left counts so many times as much for two edits, and for edits without limits
# Steps are preferred to a look if they explain that much of what is left out, and it leaves that many times as much.
# Edits by other programs leave three times as much under steps as under looks. JPEG files of weak edits are half noise.
ENOUGH, CLEARLY = 0.5, 1.2


@dataclass(frozen=True)
class FittedSteps:
    """Steps that turn photographs into edited ones, and how much of the edits they explain.

    Attributes:
        steps: in their order; none if this program's edits of brightness explain nothing.
        fitted: share of the change of the pairs that they explain, 1 at best.
        left_out: share of the change of pairs, or of parts of a single picture, explained by steps fitted without them.
        explained: the same two for all that was tried, by the names of the edits.
        are_exact: whether what they leave is no more than the rounding of files of 8 bits.
    """

    steps: tuple[Step, ...] = ()
    fitted: float = 0.0
    left_out: float = 0.0
    explained: dict[tuple[str, ...], tuple[float, float]] = field(default_factory=dict)
    are_exact: bool = False

    def apply(self, image: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """An image (B, C, H, W) in [0, 1] after the steps; values may leave [0, 1]. Differentiable in the image."""
        return apply_recipe(Recipe(self.steps), image, generator=generator)

    def to_json(self) -> str:
        """A file for ``nlfilter-torch apply``: a recipe of the steps."""
        return Recipe(self.steps).to_json(complete=True)

    @property
    def are_nearly_all(self) -> bool:
        """Whether they leave so little that a look cannot explain much more."""
        return self.left_out >= NEARLY_ALL or self.are_exact

    def explain_more_than(self, share: float) -> bool:
        """Whether they explain clearly more than a look that explains a share of the change where it is left out."""
        return self.left_out >= ENOUGH and CLEARLY * (1 - self.left_out) < 1 - share


@torch.no_grad()
@full_precision
def fit_steps(pairs: Iterable[Pair], *, order: int = 3, step: Step | None = None) -> FittedSteps:
    """Find the steps of this program, and their parameters, that turn photographs into edited ones.

    Tried are ``detail`` (sliders and threshold, also with the filters of the presets), ``tone`` and ``sharpen``, with
    soft limits and without, and two of them in either order. The parameters minimise the squared error of the clipped
    result over 32,768 pixels of each pair at the viewing size.

    Args:
        pairs: as for :func:`fit_look`, without masks. The first three photographs that the edit changes are looked at.
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
    if not search.shown:
        raise ValueError("pairs must hold a pair of photographs, got none; pass (before, after)")
    return search.fitted()


@dataclass(frozen=True, eq=False)
class Candidate:
    """Edits with the values that suit the pairs best.

    Attributes:
        edits: in their order.
        values: of each.
        fitted: share of the change that they explain.
        left_out: share explained where it was left out of the fit.
        is_exact: whether the rest is no more than the rounding of files of 8 bits.
    """

    edits: tuple[OwnEdit, ...]
    values: tuple[Tensor, ...]
    fitted: float
    left_out: float
    is_exact: bool

    @property
    def key(self) -> tuple[Key, ...]:
        """What the filters depend on."""
        return tuple(edit.key for edit in self.edits)

    def cost(self) -> float:
        """What is left, more of it for what is less usual: noise must not decide for two edits, or no limits."""
        twice, free = len(self.edits) > 1, any(edit.limits == "none" for edit in self.edits)
        return (1 - self.left_out) * (MORE if twice else 1.0) * (RARER if free else 1.0)

    @property
    def steps(self) -> tuple[Step, ...]:
        """The edits as steps with these values."""
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
        self.shown = 0  # photographs, unchanged ones included
        self.candidates: list[Candidate] = []
        self._rough: list[Candidate] = []
        self._whole: dict[Key, list[Ingredients]] = {}  # of all pixels
        self._seen: dict[Key, list[Ingredients]] = {}  # of the samples
        self._chain_start: tuple[float, Tensor, OwnEdit, OwnEdit] | None = None  # share, values and edits
        self._started = self._refined = False

    def add(self, before: Tensor, after: Tensor) -> None:
        """Add a photograph (C, H, W) before and after the edit, unless there are enough of them.

        One that is left as it is, such as an original among edited ones by mistake, says nothing of the steps.
        """
        self.shown += 1
        if len(self.pairs) < MOST_PAIRS:
            pair = ViewedPair(before, after, self.viewing_size, len(self.pairs))
            if pair.is_changed():
                self.pairs.append(pair)

    def watching(self, pairs: Iterable[tuple[Tensor, ...]]) -> Iterator[tuple[Tensor, ...]]:
        """Yield pairs, (B, C, H, W) each, that are added on the way."""
        for before, after, *others in pairs:
            self.add(before[0], after[0])
            yield before, after, *others

    @torch.no_grad()
    @full_precision
    def promise(self) -> float:
        """About the share of the change that steps explain, from a look at a sample of the pixels."""
        if not self._started:
            self._started = True
            if self.pairs and all(pair.is_of_brightness() for pair in self.pairs):
                self._look_around()
        best = self._best()
        single = 0.0 if best is None else best.left_out
        return max(single, 0.0 if self._chain_start is None else self._chain_start[0])

    def is_likely(self) -> bool:
        """Whether steps seem to explain so much that no look is needed."""
        return self.promise() >= LIKELY

    @torch.no_grad()
    @full_precision
    def fitted(self, beat: float = -math.inf) -> FittedSteps:
        """The steps that explain most; only roughly fitted if they hardly explain more than a share."""
        promise = self.promise()
        if promise > max(beat, 0.0) and not self._is_enough():
            self._refine()
        explained: dict[tuple[str, ...], tuple[float, float]] = {}
        for candidate in sorted(self._all(), key=Candidate.cost, reverse=True):
            explained[tuple(edit.edit for edit in candidate.edits)] = candidate.fitted, candidate.left_out
        best = self._best()
        if best is None or best.left_out <= 0:
            return FittedSteps(explained=explained)
        return FittedSteps(best.steps, best.fitted, best.left_out, explained, best.is_exact)

    def _all(self) -> list[Candidate]:
        """All candidates; rough ones only where there is no better one of the same edit."""
        known = {candidate.key for candidate in self.candidates}
        return [*self.candidates, *(candidate for candidate in self._rough if candidate.key not in known)]

    def _best(self) -> Candidate | None:
        return min(self._all(), key=Candidate.cost, default=None)

    def _is_enough(self) -> bool:
        """Whether an edit is fitted that explains nearly all, or all but the rounding of a file of 8 bits."""
        return any(candidate.left_out >= NEARLY_ALL or candidate.is_exact for candidate in self.candidates)

    def _edits(self, limits: Limits) -> tuple[OwnEdit, OwnEdit, OwnEdit]:
        """The edits with the default filters; the filter of the last two is the same."""
        size = self.viewing_size
        return (
            OwnSharpen(limits=limits, viewing_size=size),
            OwnTone(limits=limits, viewing_size=size, filter=self.filter),
            OwnDetail(limits=limits, viewing_size=size, filter=self.filter, order=self.order),
        )

    def _look_around(self) -> None:
        """Look at all edits, most of them roughly, those that take least time first."""
        sharpen, tone, detail = self._edits("soft")
        self._try([sharpen])
        if self._is_enough():
            return
        edits = [tone, detail]
        self._look_at(edits)
        best = max(candidate.left_out for candidate in self._all())
        if PROMISING < best < LIKELY and not self.filter:
            edits = [replace(detail, filter=other) for other in filters_of_presets()]
            self._look_at(edits)
        self._begin_chain()

    def _look_at(self, edits: Sequence[OwnEdit]) -> None:
        """Fit edits roughly, with soft limits."""
        for edit in edits:
            self._seen[edit.key] = [edit.roughly(pair.image, pair.places) for pair in self.pairs]
            self._rough.append(self._fit(edit))

    def _refine(self) -> None:
        """Fit what looks best, until it explains nearly all."""
        if self._refined:
            return
        self._refined = True
        best = self._best_single()
        # Rough layers leave a little that two edits seem to explain.
        if best in self._rough and best.left_out >= CLOSE:
            self._try(best.edits)
        start, single = self._chain_start, self._best_single()
        if start is not None and not self._is_enough() and 1 - start[0] < LESS * (1 - single.left_out):
            self._fit_chain(*start[1:])
        best = self._best_single()
        if best in self._rough and not self._is_enough():
            self._try(best.edits)

    def _best_single(self) -> Candidate:
        return min((candidate for candidate in self._all() if len(candidate.edits) == 1), key=Candidate.cost)

    def _try(self, edits: Sequence[OwnEdit]) -> None:
        """Fit edits with the same filter, with each kind of limits."""
        self._prepare(edits)
        for edit in edits:
            places = zip(self._whole[edit.key], self.pairs, strict=True)
            self._seen[edit.key] = [seen.at(pair.places) for seen, pair in places]
            self.candidates += [self._fit(replace(edit, limits=limits)) for limits in ("soft", "none")]

    def _prepare(self, edits: Sequence[OwnEdit]) -> None:
        """Compute what edits with the same filter need to know of the pairs."""
        edits = [edit for edit in edits if edit.key not in self._whole]
        for pair in self.pairs if edits else []:
            operator = edits[0].operator(InMemory(pair.image))  # one at a time is in memory
            for edit in edits:
                self._whole.setdefault(edit.key, []).append(edit.ingredients(pair.image, operator))

    def _fit(self, edit: OwnEdit) -> Candidate:
        """The values of an edit that suit the pairs best, from a coarse sample to a finer one."""
        seen = self._seen[edit.key]
        coarse = minimize(Errors(edit, self.pairs, seen, COARSE), edit.start, edit.ends, COARSE_STEPS)
        errors = Errors(edit, self.pairs, seen)
        fine = minimize(errors, coarse.values.tolist(), edit.ends, FINE_STEPS)
        return self._candidate((edit,), rounded(errors, fine, plain(edit.usual, edit.idle), edit.ends))

    def _begin_chain(self) -> None:
        """Look for two edits that promise more, one after the other, than one."""
        starts = []
        for first, second in combinations(self._edits("soft"), 2):
            step = 2 * COARSE
            start = Chain(first, second, self.pairs, []).start(self._seen[first.key], self._seen[second.key], step)
            starts.append((step * start.loss / self._power(), start.values, first, second))
        left, values, first, second = min(starts, key=itemgetter(0))
        if left < min(UNPROMISING, LESS * (1 - max(candidate.left_out for candidate in self._all()))):
            self._chain_start = 1 - left, values, first, second

    def _fit_chain(self, values: Tensor, first: OwnEdit, second: OwnEdit) -> None:
        """Fit two edits in both orders, from values that they nearly have."""
        self._prepare([edit for edit in (first, second) if edit.has_layers])
        orders = ((first, second), (second, first))
        chain, turned = (Chain(*edits, self.pairs, self._whole[edits[0].key]) for edits in orders)
        best = chain.begin(values)
        if not is_exact(best):
            count = len(first.start)
            other = turned.begin(torch.cat([values[count:], values[:count]]))
            chain, best = min((chain, best), (turned, other), key=_loss)
        if not is_exact(best):
            best = chain.snapped(chain.better(best))
        best = rounded(best.predicted, best, plain(chain.usual, chain.idle), chain.ends)
        self.candidates.append(self._candidate((chain.first, chain.second), best))

    def _power(self) -> float:
        return sum(float(pair.change().square().sum()) for pair in self.pairs)

    def _candidate(self, edits: tuple[OwnEdit, ...], best: Minimum) -> Candidate:
        groups = torch.cat([pair.groups(len(self.pairs) == 1) for pair in self.pairs])
        power = self._power()
        left_out = float(best.left_out(groups).square().sum())
        values = best.values.split([len(edit.start) for edit in edits])
        return Candidate(edits, values, 1 - best.loss / power, 1 - left_out / power, is_exact(best))


def plain(usual: Sequence[Sequence[float]], idle: Sequence[float]) -> list[tuple[float, ...]]:
    """Values that are tried first: what they often are, and those that change nothing."""
    return [(*values, value) for values, value in zip(usual, idle, strict=True)]


def _loss(order: tuple[Chain, Minimum]) -> float:
    return order[1].loss


def filters_of_presets() -> list[tuple[tuple[str, Value], ...]]:
    """Parameters of the filters of the presets that are not the default ones."""
    filters = [tuple((n, v) for n, v in recipe.steps[0].values if n in FILTER_NAMES) for recipe in PRESETS.values()]
    return [filter for filter in dict.fromkeys(filters) if filter]
