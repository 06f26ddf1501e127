"""The look that explains edits best, from the sums of :mod:`nlfilter_torch.photo.looks.look_sums`.

Which parts a look has, and how strong a ridge keeps them close to the identity, is chosen by cross-validation: pairs
are left out, or parts of the picture if there is a single pair. A least-squares problem with bounds keeps curves from
falling.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from scipy.optimize import nnls
from torch import Tensor

from nlfilter_torch.photo.looks.look_sums import LookSums, PartLayout, Parts

#: What a look may consist of, the simplest first. ``tone`` is one curve for all channels, ``curves`` one for each.
CHOICES: tuple[Parts, ...] = (
    ("alpha",),
    ("matrix",),
    ("saturation",),
    ("tone",),
    ("bands",),
    ("texture",),
    ("matrix", "saturation"),
    ("tone", "matrix"),
    ("bands", "matrix"),
    ("curves",),
    ("stretch",),
    ("local",),
    ("stretch", "local"),
    ("bands", "texture"),
    ("tone", "bands"),
    ("alpha", "bands"),
    ("curves", "matrix", "saturation"),
    ("tone", "matrix", "bands"),
    ("stretch", "bands", "local"),
    ("alpha", "bands", "texture"),
    ("alpha", "bands", "local"),
    ("tone", "matrix", "bands", "local"),
    ("alpha", "tone", "matrix", "saturation"),
    ("alpha", "tone", "matrix", "saturation", "bands"),
    ("curves", "matrix", "saturation", "bands"),
    ("alpha", "curves", "matrix", "saturation", "bands"),
    ("alpha", "tone", "matrix", "saturation", "bands", "local"),
    ("alpha", "tone", "matrix", "saturation", "bands", "texture"),
    ("alpha", "curves", "matrix", "saturation", "bands", "texture", "local"),
)
# Relative to the squares of the columns: from one that only rounding would notice to one that keeps the identity.
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
# Penalty on the second differences of a curve, relative to that on its distance from the identity. The factors of
# saturation have the latter only.
ROUGHNESS = {"tone": 10.0, "curves": 10.0, "saturation": 0.0}
SLACK, FAINT = 1.1, 0.0003  # a simpler look is chosen if its risk is at most SLACK times the smallest one plus FAINT
MILD = 30.0  # the smallest ridge for several pairs is their risk divided by this
STIFF, STIFF_ALONE = 3e-3, 1e-2  # smallest ridge of tone curves and saturation, for several pairs and for one
STIFFEST_CURVES = 0.03  # limit of the ridge of tone curves and saturation that follows from the risk of several pairs
UNEXPLAINED = 0.05  # risk of a single pair above which tone curves are chosen only if they are worth it, see WORTH
WORTH = 1.5  # looks without tone curves are preferred if their risk is at most this multiple of the best one
SHRINK = 0.5  # a look from a single pair is weakened by this multiple of the share that it leaves unexplained
CURVED = {"tone", "curves"}


@dataclass(frozen=True)
class Candidate:
    """The best look with some parts.

    Attributes:
        parts: what it consists of.
        coefficients: (3, F) of the columns.
        fitted: share of the change that it explains.
        left_out: share of the change of each fold explained by the look fitted to the others.
        risk: mean share of the change of a fold left unexplained by the look fitted to the others; small changes count
            less.
        ridge: the one that was chosen.
        stiff: its smallest value for tone curves and saturation.
        lattice: changes (3, n, n, n) by colour, of what the other parts leave; None if there are none.
    """

    parts: Parts
    coefficients: Tensor
    fitted: float
    left_out: float
    risk: float
    ridge: float = 0.0
    stiff: float = 0.0
    lattice: Tensor | None = None

    def fitted_to(self, sums: LookSums, layout: PartLayout) -> Tensor:
        """Coefficients (3, F) of the look with the same parts and ridge, fitted to other sums."""
        return fit_parts(sums, self.parts, layout, self.ridge, self.stiff)


def cross_validated(
    folds: Sequence[LookSums], layout: PartLayout, choices: Sequence[Parts], *, alone: bool
) -> dict[Parts, Candidate]:
    """Choose the ridge for each choice of parts by cross-validation: each fold in turn is left out.

    If looks leave much of an edit unexplained, it depends on the picture, and so do the parameters fitted to the rest.
    The smallest ridge therefore grows with the risk.

    Args:
        folds: sums of pairs, or of parts of a picture.
        layout: of the columns.
        choices: of parts.
        alone: whether the folds are parts of one picture, for which ridges are larger.
    """
    stiff = STIFF_ALONE if alone else STIFF
    candidates = {parts: _candidate(folds, layout, parts, stiff, RIDGES) for parts in choices}
    risk = min(candidate.risk for candidate in candidates.values())
    if risk <= stiff:
        return candidates
    ridges = tuple(ridge for ridge in RIDGES if ridge >= (risk if alone else risk / MILD)) or RIDGES[-1:]
    stiff = risk if alone else max(stiff, min(risk, STIFFEST_CURVES))
    return {parts: _candidate(folds, layout, parts, stiff, ridges) for parts in choices}


def _candidate(
    folds: Sequence[LookSums], layout: PartLayout, parts: Parts, stiff: float, ridges: Sequence[float]
) -> Candidate:
    """The look with some parts and the best of several ridges."""
    total = reduce(LookSums.__add__, folds)
    powers = torch.stack([sums.power.sum() for sums in folds])
    spread = layout.spread(parts)
    products = [_products(sums, spread) for sums in folds]
    grams, crosses = (torch.stack(values) for values in zip(*products, strict=True))
    other_grams, other_crosses = grams.sum(0) - grams, crosses.sum(0) - crosses
    penalties = [_penalties(gram, parts, layout) for gram in other_grams]
    free, bent = (torch.stack(weights) for weights in zip(*penalties, strict=True))
    ridged = torch.stack([other_grams + ridge * free + max(ridge, stiff) * bent for ridge in ridges])
    solved = torch.linalg.solve(ridged + _floor(other_grams), other_crosses.expand(len(ridges), -1, -1))
    changes = torch.einsum("rfp,fpq,rfq->rf", solved, grams, solved)
    changes = changes - 2 * torch.einsum("rfp,fp->rf", solved, crosses)
    risks = ((changes + powers) / (powers + powers.mean().clamp(min=1e-30))).mean(1)
    best = int(risks.argmin())
    coefficients = fit_parts(total, parts, layout, ridges[best], stiff)
    left_out = -float(changes[best].sum()) / max(float(total.power.sum()), 1e-30)
    return Candidate(
        parts, coefficients, total.explained(coefficients), left_out, float(risks[best]), ridges[best], stiff
    )


def fit_parts(sums: LookSums, parts: Parts, layout: PartLayout, ridge: float, stiff: float = 0.0) -> Tensor:
    """Coefficients (3, F) of the look with some parts that explains most.

    ``ridge`` is the weight of the distance from the identity. ``stiff`` is its smallest value for tone curves and
    saturation, since few pictures have colours of every brightness and saturation.
    """
    spread = layout.spread(parts)
    gram, cross = _products(sums, spread)
    free, bent = _penalties(gram, parts, layout)
    return spread @ _solve(gram + ridge * free + max(ridge, stiff) * bent + _floor(gram), cross, parts, layout)


def simplest(candidates: Mapping[Parts, Candidate]) -> Candidate:
    """The first candidate whose risk is hardly larger than the smallest one."""
    least = min(candidate.risk for candidate in candidates.values())
    return next(candidate for candidate in candidates.values() if candidate.risk <= SLACK * least + FAINT)


def choose_from_one(
    folds: Sequence[LookSums], layout: PartLayout, choices: Sequence[Parts]
) -> tuple[Candidate, dict[Parts, Candidate]]:
    """The look of a single pair, and the best one for each choice of parts.

    Parts of one picture are more alike than different pictures are, so cross-validation is too optimistic where the
    look does not explain the edit. Ridges are therefore larger; tone curves, which stand for whatever goes with
    brightness in this picture, are chosen only if they explain much more than other parts do; and the look is weakened
    in proportion to the share that it leaves unexplained.
    """
    candidates = cross_validated(folds, layout, choices, alone=True)
    best = simplest(candidates)
    straight = {parts: candidate for parts, candidate in candidates.items() if not CURVED & set(parts)}
    other = simplest(straight) if straight else best
    best = other if UNEXPLAINED < other.risk <= WORTH * best.risk else best
    strength = 1 - SHRINK * min(max(1 - best.left_out, 0.0), 1.0)
    coefficients = strength * best.coefficients
    fitted = reduce(LookSums.__add__, folds).explained(coefficients)
    return replace(best, coefficients=coefficients, fitted=fitted), candidates


def added_by_parts(
    best: Candidate, folds: Sequence[LookSums], layout: PartLayout, *, alone: bool
) -> dict[str, tuple[float, float]]:
    """What each part of a look adds to the share that is explained, of fitted and of left-out data, the most first.

    Begins with the part that explains most of the left-out data by itself, and goes on with the one that adds most.
    """
    shares: dict[str, tuple[float, float]] = {}
    total = (0.0, 0.0)
    while len(shares) < len(best.parts):
        trials = {}
        for part in best.parts:
            if part not in shares:
                parts = tuple(other for other in best.parts if other in shares or other == part)
                whole = len(parts) == len(best.parts)
                trials[part] = best if whole else cross_validated(folds, layout, [parts], alone=alone)[parts]
        part = max(trials, key=lambda name: trials[name].left_out)
        reached = trials[part].fitted, trials[part].left_out
        shares[part] = reached[0] - total[0], reached[1] - total[1]
        total = reached
    return shares


def _products(sums: LookSums, spread: Tensor) -> tuple[Tensor, Tensor]:
    """Gram matrix (P, P) of the parameters, and their products with the change, (P,)."""
    gram = torch.einsum("cfp,cfg,cgq->pq", spread, sums.gram, spread)
    return gram, torch.einsum("cfp,cf->p", spread, sums.cross)


def _penalties(gram: Tensor, parts: Parts, layout: PartLayout) -> tuple[Tensor, Tensor]:
    """Penalties (P, P) on the distance of the parameters from the identity, in proportion to the Gram matrix.

    The first holds those of all parts but tone curves and saturation, whose penalties the second holds.
    """
    free, bent = torch.diag(gram.diagonal()), torch.zeros_like(gram)
    for part, _, place in layout.parameters(parts):
        if part in ROUGHNESS:
            free[place, place] = 0.0
            weights = _distance(place.stop - place.start, ROUGHNESS[part])
            bent[place, place] = gram.diagonal()[place].mean() * weights
    return free, bent


def _distance(length: int, rough: float) -> Tensor:
    """Penalty (K, K) on the second differences of a curve and on its distance from the identity."""
    straight = torch.eye(length, dtype=torch.float64)
    bends = straight.diff(n=2, dim=0)
    return rough * bends.mT @ bends + straight


def _floor(gram: Tensor) -> Tensor:
    """A tiny ridge, for parameters that no pixel depends on."""
    diagonal = gram.diagonal(dim1=-2, dim2=-1)
    return torch.diag_embed((1e-12 * diagonal.amax(-1, keepdim=True) + 1e-12).expand_as(diagonal))


def _solve(gram: Tensor, cross: Tensor, parts: Parts, layout: PartLayout) -> Tensor:
    """Solve the least-squares problem for the parameters (P,), under the constraint that no curve falls."""
    free = torch.linalg.solve(gram, cross)
    rows = []
    for part, _, place in layout.parameters(parts):
        if part in CURVED:
            rows.append(torch.zeros(layout.knots - 1, len(cross), dtype=gram.dtype))
            rows[-1][:, place] = torch.eye(layout.knots, dtype=gram.dtype).diff(dim=0)
    if not rows:
        return free
    rises = torch.cat(rows)
    slack = rises @ free + 1 / (layout.knots - 1)  # the parameters are changes of the identity
    if bool((slack >= 0).all()):
        return free
    # With the Gram matrix L L^T and y = L^T (x - free), the least |y| is sought with which no curve falls. It is a
    # combination of the directions of the rises, with weights (Lagrange multipliers) that are not negative.
    root = torch.linalg.cholesky(gram)
    directions = torch.linalg.solve_triangular(root, rises.mT, upper=False)
    # The default driver, gelsy, gives wrong solutions now and then (torch 2.13): its pivots are not initialised.
    needed = torch.linalg.lstsq(directions.mT, -slack.unsqueeze(1), driver="gelsd").solution.squeeze(1)
    weights, _ = nnls(directions.numpy(), needed.numpy(), maxiter=10 * len(rises))
    move = directions @ torch.from_numpy(weights)
    return free + torch.linalg.solve_triangular(root.mT, move.unsqueeze(1), upper=True).squeeze(1)
