"""A few parameters of a function by least squares: Levenberg and Marquardt, with differences for derivatives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

STEP = 1e-4  # by which parameters are moved for derivatives
DAMPING, SOFTER, HARDER, HARDEST = 1e-3, 0.1, 10.0, 1e6
SETTLED = 1e-4  # relative decrease of the sum of squares below which the search ends
NEAR = 0.02  # distance of a value from its rounding, relative or, below 1, absolute
IDLE = 1e-9  # squared norm of the derivatives of a parameter that hardly matters, relative to the largest
TINY = 1e-9  # damping for parameters that nearly depend on each other
GRIDS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)  # whose multiples are tried
EQUAL = 0.01  # relative increase of the sum of squares that rounding the parameters may cost
FAINT = 2e-5  # residual that counts as none

Residuals = Callable[[Tensor], Tensor]  # of the parameters (p,), (R,)


@dataclass(frozen=True, eq=False)
class Minimum:
    """Parameters of least squares.

    Attributes:
        values: (p,), in float64.
        residuals: (R,).
        jacobian: derivatives (R, p) of the residuals.
    """

    values: Tensor
    residuals: Tensor
    jacobian: Tensor

    @property
    def loss(self) -> float:
        """Sum of squares."""
        return float(self.residuals.square().sum())

    def predicted(self, values: Tensor) -> Tensor:
        """Residuals (R,) at other values, to first order."""
        return self.residuals + self.jacobian @ (values - self.values)

    def following(self, first: Tensor) -> Tensor:
        """Values (p,) that start with given ones (q,), and the best others for these, to first order."""
        count, gram = len(first), self.jacobian.mT @ self.jacobian
        change = first - self.values[:count]
        others = _solved(gram[count:, count:], gram[count:, :count] @ change, TINY)
        return torch.cat([first, self.values[count:] - others])

    def left_out(self, groups: Tensor) -> Tensor:
        """Residuals (R,) of each group, by their numbers (R,), under parameters fitted to the others.

        To first order: one step of Gauss and Newton from the parameters that are fitted to all.
        """
        gram, slope = self.jacobian.mT @ self.jacobian, self.jacobian.mT @ self.residuals
        residuals = self.residuals.clone()
        for group in groups.unique():
            inside = groups == group
            rows = self.jacobian[inside]
            rest, pull = gram - rows.mT @ rows, slope - rows.mT @ self.residuals[inside]
            residuals[inside] = self.residuals[inside] - rows @ _solved(rest, pull, 0.0)
        return residuals


def minimize(residuals: Residuals, start: Sequence[float], ends: Sequence[tuple[float, float]], steps: int) -> Minimum:
    """The parameters within their ``ends`` for which the sum of squares of the residuals is least near a start."""
    least, most = torch.tensor(ends, dtype=torch.float64).unbind(1)
    best = _at(residuals, torch.tensor(start, dtype=torch.float64).clamp(least, most), most)
    damping = DAMPING
    for _ in range(steps):
        change = step_of(best, damping)
        values = (best.values - change).clamp(least, most)
        moved = residuals(values)
        gain = 1 - float(moved.square().sum()) / max(best.loss, 1e-30)
        if gain > 0:
            best, damping = _at(residuals, values, most, moved), damping * SOFTER
            if gain < SETTLED:
                break
        elif damping >= HARDEST or float(change.abs().max()) < STEP:
            break
        else:
            damping *= HARDER
    return best


def rounded(
    residuals: Residuals,
    best: Minimum,
    usual: Sequence[Sequence[float]],
    ends: Sequence[tuple[float, float]],
    *,
    grids: Sequence[float] = GRIDS,
    equal: float = EQUAL,
    near: float = NEAR,
) -> Minimum:
    """The minimum with values that are as short as they can be, for hardly larger residuals.

    One value after the other is rounded, the last one first, and those before it follow, to first order. ``usual`` are
    tried first, then multiples of some ``grids`` as ``near``, for a relative increase of ``equal``.
    """
    least, most = torch.tensor(ends, dtype=torch.float64).unbind(1)
    gram, values = best.jacobian.mT @ best.jacobian, best.values
    for i, plain in reversed([*enumerate(usual)]):
        allowed = best.loss + (1 - i / len(usual)) * (equal * best.loss + len(best.residuals) * FAINT**2)
        own = float(values[i])
        short = [round(round(own / grid) * grid, 6) + 0.0 for grid in grids]  # no -0
        for value in (*plain, *(value for value in short if abs(value - own) <= near * max(abs(own), 1))):
            moved = values.clone()
            moved[:i] -= _solved(gram[:i, :i], gram[:i, i] * (value - own), 0.0)
            moved[i] = value
            moved = moved.clamp(least, most)
            if float(residuals(moved).square().sum()) <= allowed:
                values = moved
                break
    return replace(best, values=values, residuals=residuals(values))


def _at(residuals: Residuals, values: Tensor, most: Tensor, known: Tensor | None = None) -> Minimum:
    """Residuals and their derivatives at some values."""
    known = residuals(values) if known is None else known
    columns = []
    for i in range(len(values)):
        step = STEP if float(values[i]) + STEP <= float(most[i]) else -STEP
        moved = values.clone()
        moved[i] += step
        columns.append((residuals(moved) - known) / step)
    return Minimum(values, known, torch.stack(columns, dim=1))


def step_of(best: Minimum, damping: float) -> Tensor:
    """The step (p,) of Gauss and Newton from some values, to be subtracted, which the damping shortens."""
    return _solved(best.jacobian.mT @ best.jacobian, best.jacobian.mT @ best.residuals, damping)


def _solved(gram: Tensor, slope: Tensor, damping: float) -> Tensor:
    """Solve for a step, which the damping shortens; parameters that hardly matter stay."""
    if len(gram) == 0:
        return slope
    scale = gram.diagonal()
    matter = scale > IDLE * scale.max()
    step = torch.zeros_like(slope)
    inner = gram[matter][:, matter] + torch.diag((damping + TINY) * scale[matter])
    step[matter] = torch.linalg.solve(inner, slope[matter])
    return step
