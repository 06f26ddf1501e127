"""The values of two edits, the second applied to the result of the first.

The filter of the second edit depends on that result. It is rebuilt in every round of Gauss and Newton; derivatives are
those with the filter as it is.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.photo.look_fitting.own_edits import Ingredients, OwnEdit
from nlfilter_torch.photo.look_fitting.parameter_fit import Minimum, minimize, rounded, step_of
from nlfilter_torch.photo.look_fitting.viewed_pair import ViewedPair
from nlfilter_torch.photo.picture.in_memory import InMemory

MOVE = 1e-3  # by which parameters are moved for derivatives, in float32
DAMPING = 1e-4
STEPS = 12  # of the search for a start
COARSE, INNER_STEPS = 4, 6  # of the search for the values of the second edit: every so many pixels, and steps
# The filter of the second edit jumps a little with the result of the first, as its landmarks do, and only the right
# values give the right filter. People choose short numbers: they are tried if the errors do not forbid them.
# Grids of the values that are tried, and the relative increase of the sum of squares, to first order, that they may
# cost; and what they must leave to be preferred, as the jumps make small differences by chance.
SNAPS: tuple[tuple[tuple[float, ...], float], ...] = (
    ((1.0, 0.5, 0.1), 1.5),
    ((0.5, 0.1), 0.5),
    ((0.1,), 0.5),
    ((0.05, 0.01), 0.3),
)
PREFERRED = 0.8
KNOWN = 2.5  # multiple of the sum of squares that values of a preset may leave, to first order, to be tried
NOISE = 1.2  # multiple of the error of rounding to 8 bits that counts as exact


@dataclass(frozen=True, eq=False)
class Chain:
    """Two edits of pairs.

    Attributes:
        first: the first edit.
        second: the second one.
        pairs: the pairs.
        whole: what the first edit needs to know of all pixels of each pair.
    """

    first: OwnEdit
    second: OwnEdit
    pairs: Sequence[ViewedPair]
    whole: Sequence[Ingredients]

    @property
    def ends(self) -> tuple[tuple[float, float], ...]:
        """Range of each value."""
        return (*self.first.ends, *self.second.ends)

    def start(self, first: Sequence[Ingredients], second: Sequence[Ingredients], step: int) -> Minimum:
        """Values that suit the pairs if the second edit adds the layers of the pictures before the first.

        Args:
            first: what the first edit needs to know of the sample of each pair.
            second: likewise.
            step: of the sample, each ``step``-th pixel is looked at.
        """
        seen = [[planes.every(step) for planes in both] for both in (first, second)]
        count = len(self.first.start)

        def errors(values: Tensor) -> Tensor:
            parts = []
            for pair, seen_first, seen_second in zip(self.pairs, *seen, strict=True):
                between = self.first.edited(seen_first, values[:count]).clamp(0, 1)
                parts.append(pair.errors(self.second.edited(replace(seen_second, image=between), values[count:]), step))
            return torch.cat(parts)

        return minimize(errors, (*self.first.start, *self.second.start), self.ends, STEPS)

    def begin(self, values: Tensor) -> Minimum:
        """The chain near a start (p,), after a step of Gauss and Newton."""
        least = torch.tensor(self.ends, dtype=torch.float64)[:, 0]
        # A threshold of 0 has no derivative.
        usual = torch.tensor([values[0] if values else 0.0 for values in self.usual], dtype=torch.float64)
        return self.better(self._at(torch.where(values == least, usual, values)))

    def better(self, state: Minimum) -> Minimum:
        """The chain after a step, if that is better."""
        least, most = torch.tensor(self.ends, dtype=torch.float64).unbind(1)
        tried = self._at((state.values - step_of(state, DAMPING)).clamp(least, most))
        return tried if tried.loss < state.loss else state

    @property
    def usual(self) -> tuple[tuple[float, ...], ...]:
        """For each value, what it often is."""
        return (*self.first.usual, *self.second.usual)

    @property
    def idle(self) -> tuple[float, ...]:
        """Values that change nothing."""
        return (*self.first.idle, *self.second.idle)

    def snapped(self, state: Minimum) -> Minimum:
        """The chain at short values of the first edit, if that is better."""
        best, count = state, len(self.first.start)
        tried = {tuple(state.values[:count].tolist())}
        for values in self._short(state):
            first = tuple(values[:count].tolist())
            if first not in tried and not is_exact(best):
                tried.add(first)
                snapped = self._at(values, state.jacobian)
                best = snapped if snapped.loss < PREFERRED * best.loss else best
        return best

    def _short(self, state: Minimum) -> Iterator[Tensor]:
        """Short values near those of the chain."""
        for known in self.first.known:
            values = state.following(torch.tensor(known, dtype=torch.float64))
            if float(state.predicted(values).square().sum()) < KNOWN * state.loss:
                yield values
        for grids, equal in SNAPS:
            yield rounded(state.predicted, state, self.usual, self.ends, grids=grids, equal=equal, near=math.inf).values

    def _at(self, values: Tensor, jacobian: Tensor | None = None) -> Minimum:
        """The chain at values of the first edit, with the best values of the second near the given ones.

        One filter is in memory at a time. Derivatives by values of the first edit are computed unless those of a
        ``jacobian`` (R, p) will do.
        """
        count, seen, moved = len(self.first.start), list[Ingredients](), list[list[Ingredients]]()
        moves = torch.eye(count, dtype=torch.float64) * MOVE if jacobian is None else ()
        for pair, whole in zip(self.pairs, self.whole, strict=True):
            operator = self.second.operator(InMemory(self._between(whole, values[:count])))
            seen.append(self._seen(pair, whole, values[:count], operator))
            moved.append([self._seen(pair, whole, values[:count] + move, operator) for move in moves])
        few = [planes.every(COARSE) for planes in seen]
        ends = self.second.ends
        coarse = minimize(partial(self._errors, few, COARSE), values[count:].tolist(), ends, INNER_STEPS)
        inner = minimize(partial(self._errors, seen, 1), coarse.values.tolist(), ends, 1)
        if jacobian is None:
            errors = [self._errors(planes, 1, inner.values) for planes in zip(*moved, strict=True)]
            jacobian = torch.stack([(error - inner.residuals) / MOVE for error in errors], dim=1)
        jacobian = torch.cat([jacobian[:, :count], inner.jacobian], dim=1)
        return Minimum(torch.cat([values[:count], inner.values]), inner.residuals, jacobian)

    def _errors(self, seen: Sequence[Ingredients], step: int, values: Tensor) -> Tensor:
        """Errors (R,) for values of the second edit."""
        edited = (self.second.edited(planes, values) for planes in seen)
        return torch.cat([pair.errors(image, step) for pair, image in zip(self.pairs, edited, strict=True)])

    def _between(self, whole: Ingredients, values: Tensor) -> Tensor:
        """The picture after the first edit."""
        return self.first.edited(whole, values.to(whole.image)).clamp(0, 1)

    def _seen(self, pair: ViewedPair, whole: Ingredients, values: Tensor, operator: NonlocalOperator) -> Ingredients:
        """What the second edit needs to know of the sample, after the first edit with some values."""
        return self.second.ingredients(self._between(whole, values), operator).at(pair.places)


def is_exact(state: Minimum) -> bool:
    """Whether what is left is hardly more than the rounding of files of 8 bits."""
    return state.loss < NOISE * len(state.residuals) / (12 * 255**2)
