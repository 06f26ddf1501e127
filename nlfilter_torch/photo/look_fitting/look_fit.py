"""The look that explains edits best, from small sums over pixels. See :mod:`nlfilter_torch.photo.looks.look_filter`.

A look is linear in its parameters, so the fit needs only the sums of products of its columns, one for each parameter.
For every channel these are a tone curve's hat functions, the three colours, the distance from the largest of them at
each saturation, the bands of blurs, the changes by automatic levels and by local tone curves, and the layers of the
filter. Which parts a look has, and how strong a ridge keeps them close to the identity, is chosen by cross-validation:
pairs are left out, or parts of the picture if there is a single pair. A least-squares problem with bounds keeps curves
from falling.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor

from nlfilter_torch.photo.looks.histogram import KINDS, STRENGTHS
from nlfilter_torch.photo.looks.look_filter import BLURS, below_largest, saturation_hats

Parts = tuple[str, ...]

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
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
#: Weight of a curve's bends beside that of its distance from the identity, all that counts for factors of saturation.
ROUGHNESS = {"tone": 10.0, "curves": 10.0, "saturation": 0.0}
SLACK, FAINT = 1.1, 0.0003  # a simpler look may leave SLACK times the best one's share, plus FAINT
SMALL = 1.0  # weight of the mean change of pairs beside that of one, whose share it is divided by
MILD = 30.0  # times the least ridge is below the share that looks leave, with several pairs
STIFFEST = 0.03  # that this share makes tone curves and saturation at most, with several pairs
UNEXPLAINED = 0.05  # share left above which curves of a single pair must pass WORTH
WORTH = 1.5  # times the best look's share that a look without tone curves may leave, for a single pair
SHRINK = 0.5  # of the share that is left of parts of a single pair, by which a look is weaker
CURVED = {"tone", "curves"}
MOST = 1 << 16  # pixels of a pair that sums are taken over


@dataclass(frozen=True)
class Layout:
    """Layout of the columns of each channel.

    Attributes:
        knots: K of a tone curve.
        factors: of saturation.
        sliders: of the filter.
    """

    knots: int
    factors: int
    sliders: int

    @property
    def lengths(self) -> dict[str, int]:
        """Columns of each kind, in their order."""
        return {
            "curves": self.knots,
            "matrix": 3,
            "saturation": self.factors,
            "bands": BLURS + 1,
            "texture": BLURS,
            "stretch": KINDS,
            "local": STRENGTHS,
            "alpha": self.sliders,
        }

    @property
    def columns(self) -> int:
        """How many there are for a channel."""
        return sum(self.lengths.values())

    def place(self, part: str) -> slice:
        """The columns of a part."""
        names = list(self.lengths)
        start = sum(list(self.lengths.values())[: names.index(part)])
        return slice(start, start + self.lengths[part])

    def parameters(self, parts: Parts) -> Iterator[tuple[str, slice, slice]]:
        """The parameters of some parts, one after the other: the part, its channels, and places of its parameters.

        A part may have parameters of its own for each channel.
        """
        start = 0
        for part in parts:
            length = self.lengths["curves" if part == "tone" else part]
            each = [slice(c, c + 1) for c in range(3)] if part in ("curves", "matrix") else [slice(3)]
            for channels in each:
                yield part, channels, slice(start, start + length)
                start += length

    def spread(self, parts: Parts) -> Tensor:
        """From the parameters of some parts to the coefficients (3, F, P) of the columns of every channel."""
        every = list(self.parameters(parts))
        found = torch.zeros(3, self.columns, every[-1][2].stop, dtype=torch.float64)
        for part, channels, place in every:
            columns = self.place("curves" if part == "tone" else part)
            found[channels, columns, place] = torch.eye(place.stop - place.start, dtype=torch.float64)
        return found


@dataclass(frozen=True)
class Sums:
    """Sums over pixels, of each channel: all that is known of pairs.

    Attributes:
        gram: of the columns, (3, F, F), in float64.
        cross: of columns and change, (3, F).
        power: of the change, (3,).
    """

    gram: Tensor
    cross: Tensor
    power: Tensor

    def __add__(self, other: "Sums") -> "Sums":
        """Add the sums of two sets of pixels."""
        return Sums(self.gram + other.gram, self.cross + other.cross, self.power + other.power)

    def left(self, coefficients: Tensor) -> float:
        """Squares of the change that coefficients (3, F) leave."""
        explained = 2 * (coefficients * self.cross).sum()
        explained = explained - torch.einsum("cf,cfg,cg->", coefficients, self.gram, coefficients)
        return float(self.power.sum() - explained)

    def explained(self, coefficients: Tensor) -> float:
        """Share of the change that coefficients (3, F) explain, 1 at best."""
        return 1.0 - self.left(coefficients) / max(float(self.power.sum()), 1e-30)


def sample(weights: Tensor) -> Tensor:
    """Pixels (P,) that sums are taken over: all that have a weight (H, W), or one at random of each of many runs."""
    places = weights.flatten().nonzero().squeeze(1)
    if len(places) <= MOST:
        return places
    random = torch.rand(MOST, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return places[((torch.arange(MOST) + random) * (len(places) / MOST)).long().to(places.device)]


def columns_of(image: Tensor, weighed: Mapping[str, Tensor], layout: Layout) -> Tensor:
    """What the parameters of a look weigh at some pixels, (3, F, P), in float64.

    Args:
        image: pixels (3, P) before the edit.
        weighed: by the part of the look that weighs them: ``bands`` (3, 7, P) and ``texture`` (6, P) of the pixels,
            changes of them by ``stretch`` (3, 3, P) and by ``local`` curves (3, 8, P), and layers of luminance,
            ``alpha``, (k+1, P).
        layout: of the columns.
    """
    colours = image.double()  # the columns nearly depend on each other
    knots = torch.arange(layout.knots).to(colours).view(-1, 1)
    hats = (1 - (colours.clamp(0, 1).unsqueeze(1) * (layout.knots - 1) - knots).abs()).clamp(min=0)
    steps = saturation_hats(colours[None, :, None], layout.factors)[0, :, 0]
    below = below_largest(colours[None])[0].unsqueeze(1) * steps
    columns = {"curves": hats, "matrix": colours, "saturation": below, **weighed}
    return torch.cat([columns[part].double().expand(3, -1, -1) for part in layout.lengths], dim=1)


def sums_of(columns: Tensor, change: Tensor, weights: Tensor) -> Sums:
    """The sums of columns (3, F, P), the change (3, P) and weights (3, P) of some pixels."""
    columns, change, weights = (values.double() for values in (columns, change, weights))
    weighed = columns * weights.unsqueeze(1)
    cross = (weighed @ change.unsqueeze(2)).squeeze(2)
    return Sums(weighed @ columns.mT, cross, (weights * change.square()).sum(1))


@dataclass(frozen=True)
class Found:
    """A look that was chosen.

    Attributes:
        parts: what it consists of.
        coefficients: (3, F) of the columns.
        fitted: share of the change that it explains.
        left_out: share that looks fitted without them explain of the pairs or parts left out.
        risk: mean over these of the share that is left, with small changes counted less.
    """

    parts: Parts
    coefficients: Tensor
    fitted: float
    left_out: float
    risk: float


def choose(
    folds: Sequence[Sums], layout: Layout, choices: Sequence[Parts], stiff: float, *, alone: bool = False
) -> dict[Parts, Found]:
    """The best ridge for each choice of parts, by leaving out each of the folds in turn.

    What a look leaves of an edit depends on the picture, and so do parameters that were found beside it: the more is
    left, the stronger ridges are at least.

    Args:
        folds: sums of pairs, or of parts of a picture.
        layout: of the columns.
        choices: of parts.
        stiff: see :func:`fit_parts`.
        alone: whether the folds are parts of one picture, for which ridges are stronger.
    """
    found = _choose(folds, layout, choices, stiff, RIDGES)
    left = min(look.risk for look in found.values())
    if left <= stiff:
        return found
    ridges = tuple(ridge for ridge in RIDGES if ridge >= (left if alone else left / MILD)) or RIDGES[-1:]
    return _choose(folds, layout, choices, left if alone else max(stiff, min(left, STIFFEST)), ridges)


def _choose(
    folds: Sequence[Sums], layout: Layout, choices: Iterable[Parts], stiff: float, ridges: Sequence[float]
) -> dict[Parts, Found]:
    total = reduce(Sums.__add__, folds)
    power = max(float(total.power.sum()), 1e-30)
    found: dict[Parts, Found] = {}
    powers = torch.stack([sums.power.sum() for sums in folds])
    for parts in choices:
        spread = layout.spread(parts)
        products = [_products(sums, spread) for sums in folds]
        grams, crosses = (torch.stack(values) for values in zip(*products, strict=True))
        without, aims = grams.sum(0) - grams, crosses.sum(0) - crosses
        penalties = [_penalties(gram, parts, layout) for gram in without]
        free, bent = (torch.stack(some) for some in zip(*penalties, strict=True))
        ridged = torch.stack([without + ridge * free + max(ridge, stiff) * bent for ridge in ridges])
        solved = torch.linalg.solve(ridged + _floor(without), aims.expand(len(ridges), -1, -1))
        changes = torch.einsum("rfp,fpq,rfq->rf", solved, grams, solved)
        changes = changes - 2 * torch.einsum("rfp,fp->rf", solved, crosses)
        shares = ((changes + powers) / (powers + SMALL * powers.mean().clamp(min=1e-30))).mean(1)
        best = int(shares.argmin())
        coefficients = fit_parts(total, parts, layout, ridges[best], stiff)
        found[parts] = Found(
            parts, coefficients, total.explained(coefficients), -float(changes[best].sum()) / power, float(shares[best])
        )
    return found


def fit_parts(sums: Sums, parts: Parts, layout: Layout, ridge: float, stiff: float = 0.0) -> Tensor:
    """Coefficients (3, F) of the look of some parts that explains most.

    ``ridge`` is the weight of the distance from the identity, ``stiff`` the least one for tone curves and saturation,
    which few pictures have every value of.
    """
    spread = layout.spread(parts)
    gram, cross = _products(sums, spread)
    free, bent = _penalties(gram, parts, layout)
    return spread @ _solve(gram + ridge * free + max(ridge, stiff) * bent + _floor(gram), cross, parts, layout)


def simplest(found: dict[Parts, Found]) -> Found:
    """The first choice that leaves hardly more than the best one does."""
    least = min(look.risk for look in found.values())
    return next(look for look in found.values() if look.risk <= SLACK * least + FAINT)


def choose_from_one(
    folds: Sequence[Sums], layout: Layout, choices: Sequence[Parts], stiff: float
) -> tuple[Found, dict[Parts, Found]]:
    """The look of a single pair, and the best one of each choice of parts.

    Parts of a picture are more alike than pictures are, so that the look is to depend less on the picture where it does
    not explain the edit: ridges are stronger, curves (which stand for whatever goes with brightness there) have to
    explain much more than other parts do, and the look is weaker by some of the share that it leaves.
    """
    found = choose(folds, layout, choices, stiff, alone=True)
    best, straight = simplest(found), {parts: look for parts, look in found.items() if not CURVED & set(parts)}
    other = simplest(straight) if straight else best
    best = other if UNEXPLAINED < other.risk <= WORTH * best.risk else best
    strength = 1 - SHRINK * min(max(1 - best.left_out, 0.0), 1.0)
    coefficients = strength * best.coefficients
    fitted = reduce(Sums.__add__, folds).explained(coefficients)
    return replace(best, coefficients=coefficients, fitted=fitted), found


def _products(sums: Sums, spread: Tensor) -> tuple[Tensor, Tensor]:
    gram = torch.einsum("cfp,cfg,cgq->pq", spread, sums.gram, spread)
    return gram, torch.einsum("cfp,cf->p", spread, sums.cross)


def _penalties(gram: Tensor, parts: Parts, layout: Layout) -> tuple[Tensor, Tensor]:
    """Weights (P, P) of the distance of parameters from the identity, relative to what the columns weigh.

    Those of tone curves and saturation are apart.
    """
    free, bent = torch.diag(gram.diagonal()), torch.zeros_like(gram)
    for part, _, place in layout.parameters(parts):
        if part in ROUGHNESS:
            free[place, place] = 0.0
            weights = _distance(place.stop - place.start, ROUGHNESS[part])
            bent[place, place] = gram.diagonal()[place].mean() * weights
    return free, bent


def _distance(length: int, rough: float) -> Tensor:
    """Weights (K, K) of a curve's bends and of its distance from the identity."""
    straight = torch.eye(length, dtype=torch.float64)
    bends = straight.diff(n=2, dim=0)
    return rough * bends.mT @ bends + straight


def _floor(gram: Tensor) -> Tensor:
    """A ridge for parameters that no pixel depends on."""
    diagonal = gram.diagonal(dim1=-2, dim2=-1)
    return torch.diag_embed((1e-12 * diagonal.amax(-1, keepdim=True) + 1e-12).expand_as(diagonal))


def _solve(gram: Tensor, cross: Tensor, parts: Parts, layout: Layout) -> Tensor:
    """Parameters (P,) of the least squares under which no curve falls."""
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
    moves = torch.linalg.solve(gram, rises.mT)
    return free + moves @ nonnegative(rises @ moves, -slack)


def nonnegative(matrix: Tensor, vector: Tensor) -> Tensor:
    """The x >= 0 that minimises ``x^T A x / 2 - b^T x``, for A positive semi-definite, after Lawson and Hanson."""
    count = len(vector)
    x, free = torch.zeros_like(vector), torch.zeros(count, dtype=torch.bool)
    least = 1e-10 * vector.abs().max().clamp(min=1e-30)
    for _ in range(10 * count):
        slope = torch.where(free, -torch.inf, vector - matrix @ x)
        if bool(slope.max() <= least):
            break
        free[slope.argmax()] = True
        while True:
            wanted = torch.zeros_like(x)
            inner = matrix[free][:, free]
            jitter = 1e-13 * inner.diagonal().max() * torch.eye(len(inner), dtype=inner.dtype)
            wanted[free] = torch.linalg.solve(inner + jitter, vector[free])
            blocked = free & (wanted <= 0)
            if not bool(blocked.any()):
                x = wanted
                break
            x = x + (x[blocked] / (x[blocked] - wanted[blocked])).min() * (wanted - x)
            free &= x > 1e-14 * x.max()
            x = torch.where(free, x, 0.0)
            if not bool(free.any()):
                break
    return x
