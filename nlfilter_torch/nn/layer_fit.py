"""Fitting sliders, bandwidths and a learned guide of a layer together, to one edit, so that fits agree."""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_count, check_fits, check_image, check_instance
from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.filtering.fit import fit_alpha
from nlfilter_torch.nn.affinity import HeldAssignment
from nlfilter_torch.nn.sliders import NonlocalFilter
from nlfilter_torch.operator.features import estimate_bandwidth

PHOTOMETRIC_STARTS = tuple(2.0**power for power in range(-4, 4))  # starts, in units of the estimate of the guide
SPATIAL_STARTS = (1 / 64, 1 / 24, 1 / 10, 1 / 4, 1.0)  # starts, in units of the short side
BANDWIDTHS = ("photometric_bandwidth", "spatial_bandwidth")
BEYOND_STARTS = 16.0  # factor by which bandwidths may leave the range of the starts
BEST = 3  # starts from which the bandwidths descend
DESCENTS = 2  # descents from each, with an assignment of pixels to landmarks that is renewed before each
LEAST_EVALUATIONS = 60
SETTLED_DESCENT = 1e-9


@dataclass(frozen=True)
class LayerFit:
    """What a fit found; the layer has its parameters.

    Attributes:
        error: root mean square of the difference between the layer's output and the target, in units of the image.
        evaluations: how often the filter was built.
        photometric_bandwidth: in units of the guide, or ``"auto"``.
        spatial_bandwidth: in pixels, or None.
        alpha: the sliders.
        starts: errors of the best starts after their descents, ascending: if they differ much, the edit has several
            explanations.
    """

    error: float
    evaluations: int
    photometric_bandwidth: float | str
    spatial_bandwidth: float | None
    alpha: tuple[float, ...]
    starts: tuple[float, ...]


class _Spent(Exception):
    """All evaluations of a descent have been used."""


class _Search:
    """The problem with the sliders solved for: bandwidths and guide alone are free. Counts evaluations."""

    def __init__(
        self, layer: NonlocalFilter, image: Tensor, target: Tensor, guide: Callable[[Tensor], Tensor] | None
    ) -> None:
        self.layer, self.image, self.target, self.guide = layer, image, target, guide
        self.order = layer.alpha.shape[0] - 1
        free = [p for name, p in layer.affinity.named_parameters() if p.requires_grad]
        free += [p for p in guide.parameters() if p.requires_grad] if isinstance(guide, nn.Module) else []
        self.free, self.evaluations, self.scale = free, 0, 1.0
        self.limits: dict[nn.Parameter, tuple[float, float]] = {}  # of logarithms of bandwidths

    def error(self) -> Tensor:
        """Mean squared error with the best sliders, which are left in the layer; differentiable in what is free.

        The sliders are constants there: at their minimum, the error does not change with them.
        """
        self.evaluations += 1
        guide = self.image if self.guide is None else self.guide(self.image)
        operator = self.layer.affinity(guide, guide_channels=None if self.guide is None else "all")
        alpha = fit_alpha(operator.detach(), self.image, self.target, order=self.order, rounding=0.0, shared=True)
        with torch.no_grad():
            self.layer.alpha.copy_(alpha[0])
        return (polynomial_filter(operator, self.image, alpha[0]) - self.target).square().mean()

    def state(self) -> list[Tensor]:
        """Copies of what is free, and of the sliders."""
        return [p.detach().clone() for p in (*self.free, self.layer.alpha)]

    @torch.no_grad()
    def restore(self, state: Sequence[Tensor]) -> None:
        """Set what is free and the sliders."""
        for parameter, value in zip((*self.free, self.layer.alpha), state, strict=True):
            parameter.copy_(value)

    def anew(self) -> float:
        """Mean squared error with landmarks that are chosen anew, as the layer would; infinite if it is not finite."""
        if isinstance(self.layer.affinity.held, HeldAssignment):
            self.layer.affinity.held.forget()
        with torch.no_grad():
            error = float(self.error())
        return error if math.isfinite(error) else math.inf

    def descend(self, most: int) -> None:
        """L-BFGS with so many evaluations, and landmarks that are chosen anew before and then held; leaves its best."""
        self.scale = max(self.anew(), torch.finfo(torch.float64).tiny)
        last, best = self.evaluations + most, (math.inf, self.state())
        optimizer = torch.optim.LBFGS(
            self.free, max_iter=most, max_eval=most, tolerance_change=SETTLED_DESCENT, line_search_fn="strong_wolfe"
        )

        def closure() -> float:
            nonlocal best
            if self.evaluations >= last:  # the optimiser asks only between line searches
                raise _Spent
            with torch.no_grad():  # a line search may try bandwidths that overflow
                for parameter, (low, high) in self.limits.items():
                    parameter.clamp_(low, high)
            optimizer.zero_grad()
            value = self.error()
            scaled = value / self.scale
            scaled.backward()
            reached = float(scaled.detach())
            if reached < best[0]:
                best = reached, self.state()
            return reached

        with suppress(_Spent):
            optimizer.step(closure)
        self.restore(best[1])


@contextmanager
def _held(layer: NonlocalFilter) -> Iterator[None]:
    """Hold the assignment of pixels to landmarks, unless the layer holds something already."""
    before = layer.affinity.held
    if before is None:
        layer.affinity.held = HeldAssignment(None)
    try:
        yield
    finally:
        layer.affinity.held = before


def fit_layer(
    layer: NonlocalFilter,
    image: Tensor,
    target: Tensor,
    *,
    guide: Callable[[Tensor], Tensor] | None = None,
    evaluations: int = 300,
) -> LayerFit:
    """Fit the sliders of a layer, and the bandwidths, patch weights and guide that it learns, to an edit.

    For given bandwidths the best sliders are those of :func:`fit_alpha`, so that only the rest is searched: a grid of
    starts around the bandwidth that :func:`estimate_bandwidth` finds, whatever the layer starts from, then L-BFGS from
    the best of them. Landmarks are held while it descends, since choosing them anew makes the error jump, and renewed
    between rounds; what counts in the end is the error with landmarks chosen anew.

    Args:
        layer: whose parameters are set: ``alpha``, and what else is in its ``learn``. One row of sliders, and a
            ``residual`` of None.
        image: y, (B, C, H, W), before the edit.
        target: (B, C, H, W), after it.
        guide: computes the guide (B, C', H, W) from the image, in place of the image itself; the parameters of an
            ``nn.Module`` are fitted, too.
        evaluations: how often the filter may be built, at least 60.

    Returns:
        What was found. Bandwidths and sliders may not be determined by the edit, although the output is.

    Raises:
        TypeError, ValueError: if an argument is not of this kind, or the images do not fit.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 1, 16, 16, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(image, photometric_bandwidth=0.8, num_landmarks=20)
        >>> edited = polynomial_filter(operator, image, torch.tensor([0.5, 1.5]))
        >>> learn = ("alpha", "photometric_bandwidth")
        >>> layer = NonlocalFilter((1.0, 1.0), photometric_bandwidth=0.01, num_landmarks=20, learn=learn)
        >>> found = fit_layer(layer, image, edited, evaluations=100)
        >>> found.error < 0.5 / 255 and torch.allclose(layer(image), edited, atol=0.01)
        True
    """
    check_instance(layer, NonlocalFilter, "layer", "construct one")
    if layer.alpha.ndim > 1 or layer.residual is not None:
        raise ValueError(
            "layer must have one row of sliders and a residual of None to be fitted, got another; construct it with "
            "alpha=(1, 1, 1, 1)"
        )
    check_image(image, "image")
    check_fits(target, tuple(image.shape[2:]), "target", "image", image, channels=image.shape[1], batch=len(image))
    check_count(evaluations, "evaluations", least=LEAST_EVALUATIONS)
    search, starts = _Search(layer, image, target, guide), _starts(layer, image, guide)
    for name, places in zip(BANDWIDTHS, zip(*starts, strict=True), strict=False):
        parameter, values = getattr(layer.affinity, f"log_{name}"), [place for place in places if place is not None]
        if parameter is not None and values:
            search.limits[parameter] = math.log(min(values) / BEYOND_STARTS), math.log(max(values) * BEYOND_STARTS)
    with _held(layer), torch.enable_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bandwidths on the way
        found = [(search.anew(), search.state())]
        for photometric, spatial in starts:
            search.restore(found[0][1])
            if photometric is not None:
                layer.affinity.photometric_bandwidth = photometric
            if spatial is not None:
                layer.affinity.spatial_bandwidth = spatial
            found.append((search.anew(), search.state()))
        found.sort(key=lambda pair: pair[0])
        descended = []
        chosen = found[: BEST if search.free else 0]
        for number, (error, state) in enumerate(chosen):
            best = error, state
            for turn in range(DESCENTS):
                left = (evaluations - search.evaluations) // ((len(chosen) - number) * DESCENTS - turn) - 2
                if left < 1:
                    break
                search.restore(best[1])
                search.descend(left)
                best = min(best, (search.anew(), search.state()), key=lambda pair: pair[0])
            descended.append(best)
        error, state = min([found[0], *descended], key=lambda pair: pair[0])
        search.restore(state)
    h_y, h_x = layer.affinity.photometric_bandwidth, layer.affinity.spatial_bandwidth
    return LayerFit(
        error=math.sqrt(error),
        evaluations=search.evaluations,
        photometric_bandwidth=h_y if isinstance(h_y, str) else _number(h_y),
        spatial_bandwidth=None if h_x is None else _number(h_x),
        alpha=tuple(layer.alpha.tolist()),
        starts=tuple(sorted(math.sqrt(value) for value, _ in descended)),
    )


def _number(bandwidth: float | Tensor) -> float:
    return float(bandwidth.detach()) if isinstance(bandwidth, Tensor) else bandwidth


@torch.no_grad()
def _starts(
    layer: NonlocalFilter, image: Tensor, guide: Callable[[Tensor], Tensor] | None
) -> list[tuple[float | None, float | None]]:
    """Pairs of bandwidths to start from; None where one is not learned."""
    affinity = layer.affinity
    photometric: list[float | None] = [None]
    spatial: list[float | None] = [None]
    if isinstance(affinity.photometric_bandwidth, Tensor):
        estimate = float(estimate_bandwidth(image if guide is None else guide(image)).mean())
        photometric = [factor * max(estimate, 1e-6) for factor in PHOTOMETRIC_STARTS]
    if isinstance(affinity.spatial_bandwidth, Tensor):
        spatial = [max(share * min(image.shape[2:]), 0.5) for share in SPATIAL_STARTS]
    return [(h, s) for h in photometric for s in spatial if (h, s) != (None, None)]
