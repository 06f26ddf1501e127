"""The sliders that turn an image into a target. Paper: inverts eq. (12).

The filter is linear in alpha, so alpha is the solution of a least-squares problem with the (k+1) x (k+1) Gram matrix of
the layers. If layers are nearly equal or nearly zero, some combinations of sliders are undetermined; those stay as
close to 1, the identity, as the target allows.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import cast

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.checks import (
    check_count,
    check_fits,
    check_instance,
    check_number,
    check_order,
    check_tensor,
    check_values,
)
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.symmetric_matrix import SymmetricMatrix
from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.sure import Build, Noise, layer_divergences
from nlfilter_torch.operator.operator import NonlocalOperator

Loss = Callable[[Tensor, Tensor], Tensor]

# Combinations of unit-norm layers with a squared norm below this are rounding of the operator's dtype.
CUT = {torch.float32: 1e-10, torch.float64: 1e-11}
ROUNDING = {torch.float32: 1e-13, torch.float64: 1e-30}  # power of a layer's rounding error, relative to the image's
# Squared lengths of slider directions that are rounding error, relative to the longest and to the largest scale.
SHORT, IDLE = 1e-14, 1e-20
# A layer of less power than this, relative to the image, is the balancing error on a constant image.
VANISHED = {torch.float32: 1e-9, torch.float64: 1e-22}
# Least-squares steps: a nearly undetermined combination of sliders multiplies the rounding errors of the first step.
REFINEMENTS = 3
DESCENT_STEPS = 200
HALF_LEVEL = 0.5 / 255
OFF_LEVEL = 1e-3  # of a level: tolerance for 8-bit values stored as floats
NEWTON_STEPS, HALVINGS = 50, 8
SETTLED = 1e-9


@full_precision
def fit_alpha(
    operator: NonlocalOperator | Build,
    image: Tensor,
    target: Tensor | None = None,
    *,
    noise: Noise | None = None,
    order: int = 3,
    mask: Tensor | None = None,
    ridge: float = 0.0,
    shared: bool = False,
    rounding: float | None = None,
    loss: Loss | None = None,
    probes: int = 1,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Find the sliders that bring ``polynomial_filter(operator, image, alpha)`` closest to ``target``, or to the truth.

    Paper: inverts eq. (12). Solved in float64 for images of any dtype. With ``noise`` in place of ``target``, the
    sliders are those with the smallest error that :func:`sure` estimates for an image of such noise, which is quadratic
    in them, too.

    Args:
        operator: W. With ``noise`` also a function that takes the image and builds W: that W depends on the noise, too,
            then counts, as it must if the guide is the noisy image. The function must hold its landmarks, as by
            ``landmarks=operator``.
        image: y, (B, C, H, W), before the edit.
        target: (B, C, H, W), after it; channels have equal weight.
        noise: in place of ``target``: standard deviation of the image's white noise, a number, (B,), or a map
            (B, 1 or C, H, W); or a :class:`~nlfilter_torch.NoiseProfile`. A constant for gradients.
        order: k, at least 1; k+1 sliders are found.
        mask: (B, 1, H, W) or (1, 1, H, W), non-negative weights of the pixels; None weighs all equally. Points that
            represent several pixels count for as many.
        ridge: weight of the penalty ``|alpha - 1|^2`` relative to the mean squared error, at least 0.
        shared: one alpha for the whole batch, rather than one for each image.
        rounding: half the step between the values of ``target``, such as 0.5 / 255 for 8 bits. Errors up to it are
            ignored, and so are values beyond a target of 0 or 1, which a file clips. None is 0.5 / 255 for each target
            that, where it counts, holds only multiples of 1 / 255, and 0.0, ordinary least squares, for others.
        loss: ``loss(filtered, target)``, a number to be minimised by L-BFGS from the least-squares solution; None
            returns that solution. Where ``mask`` is 0 both arguments are the target, and between that and its
            largest value they are blended.
        probes: with ``noise``, the number of random fields with which derivatives are estimated, unless W is given and
            the noise is white: then the trace is exact.
        generator: of the probes; None draws the same in every call.

    Returns:
        alpha, (B, k+1), or (1, k+1) if ``shared``, in the image's dtype, with the smallest mean squared error or
        ``loss``. Ones if the image determines nothing, such as a constant one. Differentiable in image, target, mask
        and operator, unless ``loss`` is given.

    Raises:
        TypeError, ValueError: if ``image``, ``target`` or ``mask`` do not fit together, ``mask`` is negative or all
            zero for an image, ``order`` is not a positive integer, ``noise``, ``ridge`` or ``rounding`` is negative, or
            not exactly one of ``target`` and ``noise`` is given.

    Example:
        >>> from nlfilter_torch import nonlocal_operator, polynomial_filter
        >>> image = torch.rand(1, 1, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(image, num_landmarks=20)
        >>> edited = polynomial_filter(operator, image, torch.tensor([3.0, 1.0, 1.2]))
        >>> [round(a, 2) for a in fit_alpha(operator, image, edited, order=2)[0].tolist()]
        [3.0, 1.0, 1.2]
    """
    if noise is not None and target is None:
        return _fit_to_noise(
            operator,
            image,
            noise,
            order=order,
            mask=mask,
            ridge=ridge,
            shared=shared,
            alone=rounding is None and loss is None,
            probes=probes,
            generator=generator,
        )
    if target is None or noise is not None:
        raise ValueError(
            f"target must be given, or else noise, got {'neither' if noise is None else 'both'}; pass one of them"
        )
    check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
    operator = cast(NonlocalOperator, operator)
    if loss is not None and not callable(loss):
        raise TypeError(f"loss must be a function of two images, got {type(loss).__name__}; pass a function or None")
    if loss is not None:
        operator.communicator.check_whole("a loss")
    layers, weights = _checked_layers(operator, image, order, mask, ridge, shared)
    batch = max(image.shape[0], operator.factor.shape[0])
    check_fits(target, tuple(image.shape[2:]), "target", "image", image, channels=image.shape[1], batch=batch)
    if rounding is not None:
        _check_not_negative(rounding, "rounding")
    aims = target.detach().double().flatten(1)
    if rounding is None:
        zone = _roundings(aims, weights, operator.communicator)
        ignored = bool((zone > 0.0).any())
    else:
        zone, ignored = aims.new_full((1, 1), rounding), rounding > 0.0
    problem = _Problem(
        layers=layers.flatten(2),
        edit=(target.double() - layers.sum(1)).flatten(1),
        dead_zone=_dead_zone(aims, zone) if ignored else None,
        weights=weights,
        ridge=ridge,
        shared=shared,
        precision=operator.factor.dtype,
        communicator=operator.communicator,
    )
    change = problem.fit()
    if loss is not None:
        change = problem.descend(change, loss, target.double(), mask)
    return (1.0 + change).to(image.dtype)


def _checked_layers(
    operator: NonlocalOperator, image: Tensor, order: int, mask: Tensor | None, ridge: float, shared: bool
) -> tuple[Tensor, Tensor]:
    """Check what both kinds of fits take; layers (B, k+1, C, H, W) in float64, and weights (B or 1, P)."""
    check_instance(shared, bool, "shared", "pass True or False")
    check_order(order)
    check_fits(image, operator.size, "image", "operator", operator.factor)
    _check_not_negative(ridge, "ridge")
    layers = detail_layers(operator, image.to(operator.factor), order=order).double()
    return layers, _pixel_weights(mask, operator, layers).flatten(1)


def _fit_to_noise(
    operator: NonlocalOperator | Build,
    image: Tensor,
    noise: Noise,
    *,
    order: int,
    mask: Tensor | None,
    ridge: float,
    shared: bool,
    alone: bool,
    probes: int,
    generator: torch.Generator | None,
) -> Tensor:
    """:func:`fit_alpha` without a target, and, if ``alone``, without what only a target allows."""
    if not alone:
        raise ValueError("rounding and loss must be None with noise, got one of them; they need a target")
    check_count(probes, "probes")
    built = operator if isinstance(operator, NonlocalOperator) else operator(image)
    check_instance(built, NonlocalOperator, "operator", "make it with nonlocal_operator, or pass a function that does")
    layers, weights = _checked_layers(built, image, order, mask, ridge, shared)
    shares = weights.unflatten(1, (image.shape[1], -1))
    divergence = layer_divergences(
        operator, image.to(built.factor), noise, shares, order, probes=probes, generator=generator
    )
    problem = _Problem(
        layers=layers.flatten(2),
        edit=torch.zeros_like(layers[:, 0]).flatten(1),
        dead_zone=None,
        weights=weights,
        ridge=ridge,
        shared=shared,
        precision=built.factor.dtype,
        communicator=built.communicator,
        divergence=divergence,
    )
    return (1.0 + problem.fit()).to(image.dtype)


@torch.no_grad()
def fit_layers(layers: Tensor, image: Tensor, target: Tensor, weights: Tensor, rounding: float) -> Tensor:
    """:func:`fit_alpha` for some values of an image and the layers that are added to it, which need not add up to it.

    Args:
        layers: (k+1, P).
        image: values (P,) before the edit.
        target: (P,) after it.
        weights: (P,), not all 0.
        rounding: half the step between the values of ``target``.

    Returns:
        alpha, (k+1,), in float64.
    """
    aim = target.double()[None]
    problem = _Problem(
        layers=layers.double()[None],
        edit=aim - image.double()[None],
        dead_zone=_dead_zone(aim, aim.new_tensor([[rounding]])) if rounding > 0.0 else None,
        weights=(weights.double() / weights.double().sum())[None],
        ridge=0.0,
        shared=False,
        precision=layers.dtype,
        communicator=ALONE,
    )
    return 1.0 + problem.fit()[0]


def _check_not_negative(value: float, name: str) -> None:
    check_number(value, name, "pass 0.0 or more")
    check_values(value, name, "not negative", remedy="0.0 is plain least squares")


def _roundings(target: Tensor, weights: Tensor, communicator: Communicator) -> Tensor:
    """Half a level (B, 1) for targets (B, P) whose values of positive weight are multiples of 1/255, 0 for others."""
    levels = 255 * target
    off = torch.where(weights > 0, (levels - levels.round()).abs(), 0.0)
    return HALF_LEVEL * (communicator.max(off.amax(1, keepdim=True)) < OFF_LEVEL).double()


def _dead_zone(target: Tensor, rounding: Tensor) -> tuple[Tensor, Tensor]:
    """Range of errors (target minus filtered) that count as zero; unbounded on one side for a clipped pixel.

    The rounding (B, 1) is 0 for targets without such a range.
    """
    low = torch.where((target >= 1.0) & (rounding > 0.0), -math.inf, -rounding)
    high = torch.where((target <= 0.0) & (rounding > 0.0), math.inf, rounding)
    return low, high


@dataclass(frozen=True)
class _Problem:
    """Fit ``edit`` by a change of the sliders from 1, the identity.

    Attributes:
        layers: (B, k+1, P), all values of an image in one row.
        edit: (B, P).
        dead_zone: limits (B, P) between which errors count as zero; None if there are none.
        weights: (B, P) or (1, P), of unit sum.
        ridge: see :func:`fit_alpha`.
        shared: one change for all images.
        precision: dtype in which the layers were computed.
        communicator: ranks that the rows of the images are spread over.
        divergence: (B, k+1), half the slope of a term that is linear in the change; None is 0.
    """

    layers: Tensor
    edit: Tensor
    dead_zone: tuple[Tensor, Tensor] | None
    weights: Tensor
    ridge: float
    shared: bool
    precision: torch.dtype
    communicator: Communicator
    divergence: Tensor | None = None

    def fit(self) -> Tensor:
        """Least-squares change (B, k+1) with the dead zone.

        Rounding errors are systematic: an edit of less than half a level always disappears, so ordinary least squares
        underestimates the sliders. With the dead zone the true sliders have no error. The objective is convex,
        piecewise quadratic and differentiable; Newton's method converges in a few steps.
        """
        batch = 1 if self.shared else self.layers.shape[0]
        start = self.layers.new_zeros(batch, self.layers.shape[1])
        if self.dead_zone is None:
            change = start
            for _ in range(REFINEMENTS):
                change = change + self._step(change)
            return self._least(change)
        with torch.no_grad():
            change = replace(self, dead_zone=None)._step(start)
            for _ in range(NEWTON_STEPS):
                step, cost = self._step(change), self._cost(change)
                for _ in range(HALVINGS):
                    worse = self._cost(change + step) > cost
                    step = torch.where(worse.unsqueeze(1), step / 2, step)
                change = change + step
                if bool((step.abs() < SETTLED).all()):
                    break
        return self._least(change + self._step(change))  # a last step for the gradient

    def _least(self, change: Tensor) -> Tensor:
        """The smallest change (B, k+1) with the same effect, which favours the stronger of two proportional layers."""
        scale, matrix, counted = self._scaled(self._products)
        idle = matrix.apply(torch.ones_like, ~counted)  # a projector, (B, k+1, k+1)
        moves = scale.unsqueeze(2) * idle  # combinations of sliders without effect
        inner = SymmetricMatrix.of(moves.mT @ moves)
        # Shorter directions are rounding error.
        least = torch.maximum(SHORT * inner.eigenvalues[:, :1], IDLE * scale.amax(1, True).square())
        real = inner.eigenvalues > least
        inverse = inner.apply(torch.reciprocal, real)
        return change - (moves @ (inverse @ (moves.mT @ change.unsqueeze(2)))).squeeze(2)

    @cached_property
    def _products(self) -> Tensor:
        """Gram matrix of the layers, (B, k+1, k+1), without a dead zone."""
        return self._weighed(self.weights)

    def _weighed(self, weights: Tensor) -> Tensor:
        """Gram matrix of the layers, (B, k+1, k+1), under weights (B, P)."""
        return self._pool(self.communicator.sum((self.layers * weights.unsqueeze(1)) @ self.layers.mT))

    def _errors(self, change: Tensor) -> Tensor:
        """Remaining error of the edit, (B, P)."""
        errors = self.edit - (change.unsqueeze(1) @ self.layers).squeeze(1)
        return errors if self.dead_zone is None else errors - errors.clamp(*self.dead_zone)

    def _pool(self, values: Tensor) -> Tensor:
        return values.mean(0, keepdim=True) if self.shared else values

    def _cost(self, change: Tensor) -> Tensor:
        squares = self.communicator.sum((self.weights * self._errors(change).square()).sum(1))
        return self._pool(squares) + self.ridge * change.square().sum(1)

    def _step(self, change: Tensor) -> Tensor:
        """Newton's step (B, k+1); without a dead zone it leads to the solution from any point."""
        errors = self._errors(change)
        products = self._products if self.dead_zone is None else self._weighed(self.weights * (errors != 0.0))
        slope = self.communicator.sum((self.layers @ (self.weights * errors).unsqueeze(2)).squeeze(2))
        if self.divergence is not None:
            slope = slope - self.divergence
        slope = self._pool(slope) - self.ridge * change
        scale, inverse = self._inverse(products)
        return scale * (inverse @ (scale * slope).unsqueeze(2)).squeeze(2)

    def _inverse(self, products: Tensor) -> tuple[Tensor, Tensor]:
        """Scales (B, k+1) of the layers, and the pseudo-inverse (B, k+1, k+1) of the scaled Gram matrix."""
        scale, matrix, counted = self._scaled(products)
        return scale, matrix.apply(torch.reciprocal, counted)

    def _scaled(self, products: Tensor) -> tuple[Tensor, SymmetricMatrix, Tensor]:
        """Scales (B, k+1) of the layers, their scaled Gram matrix, and which of its eigenvalues exceed rounding.

        The scales normalise the layers; a layer that is rounding error has scale 0.
        """
        products = products + self.ridge * torch.eye(products.shape[1]).to(products)
        power = products.diagonal(dim1=1, dim2=2)
        # The layers sum to the image, so the largest of them is of its magnitude.
        share = power / power.amax(1, keepdim=True).clamp(min=torch.finfo(power.dtype).tiny)
        present = share > VANISHED[self.precision]
        scale = torch.where(present, power, torch.ones_like(power)).rsqrt() * present
        matrix = SymmetricMatrix.of(scale.unsqueeze(2) * products * scale.unsqueeze(1))
        # Scaling amplifies the rounding errors of small layers.
        rounding = ROUNDING[self.precision] / torch.where(present, share, torch.ones_like(share)).detach()
        floor = (matrix.vectors.square() * rounding.unsqueeze(2)).sum(1).clamp(min=CUT[self.precision])
        return scale, matrix, matrix.eigenvalues > floor

    @torch.no_grad()
    def descend(self, start: Tensor, loss: Loss, target: Tensor, mask: Tensor | None) -> Tensor:
        """Change (B, k+1) that minimises ``loss``, by L-BFGS in a basis that makes the squared error isotropic."""
        scale, inverse = self._inverse(self._products)
        basis = scale.unsqueeze(2) * SymmetricMatrix.of(inverse).apply(torch.sqrt, torch.ones_like(scale).bool())
        filtered_shape = (self.layers.shape[0], *target.shape[1:])
        target = target.expand(filtered_shape)
        descent = _Descent(
            start=start,
            basis=basis,
            layers=self.layers,
            image=target - self.edit.view(filtered_shape),
            target=target,
            shares=None if mask is None else mask.to(target) / mask.amax((1, 2, 3), keepdim=True),
            ridge=self.ridge,
            loss=loss,
        )
        coefficients = torch.zeros_like(start).requires_grad_()
        optimizer = torch.optim.LBFGS(
            [coefficients],
            max_iter=DESCENT_STEPS,
            tolerance_grad=1e-9,
            tolerance_change=1e-12,
            line_search_fn="strong_wolfe",
        )
        optimizer.step(partial(descent.differentiate, optimizer, coefficients))
        return descent.change(coefficients.detach())


@dataclass(frozen=True)
class _Descent:
    """Minimisation of a loss over coefficients (B, k+1) of a change of the sliders.

    Attributes:
        start: change (B, k+1) for coefficients of 0.
        basis: (B, k+1, k+1), from coefficients to changes.
        layers: (B, k+1, P).
        image: (B, C, H, W), before the edit.
        target: (B, C, H, W).
        shares: (B, 1, H, W), the share of the filtered image where it is blended with the target; None means 1.
        ridge: see :func:`fit_alpha`.
        loss: see :func:`fit_alpha`.
    """

    start: Tensor
    basis: Tensor
    layers: Tensor
    image: Tensor
    target: Tensor
    shares: Tensor | None
    ridge: float
    loss: Loss

    def change(self, coefficients: Tensor) -> Tensor:
        """Change (B, k+1) of the sliders."""
        return self.start + (self.basis @ coefficients.unsqueeze(2)).squeeze(2)

    @torch.enable_grad()
    def differentiate(self, optimizer: torch.optim.Optimizer, coefficients: Tensor) -> Tensor:
        """Compute what is minimised, and its gradient with respect to the coefficients."""
        optimizer.zero_grad()
        change = self.change(coefficients)
        filtered = self.image + (change.unsqueeze(1) @ self.layers).view(self.target.shape)
        if self.shares is not None:
            filtered = torch.lerp(self.target, filtered, self.shares)
        value = self.loss(filtered, self.target)
        check_tensor(value, "loss", "return a number that depends on the first image")
        if value.numel() != 1 or not value.requires_grad:
            raise ValueError(
                f"loss must return a single number with a gradient, got a tensor of shape {tuple(value.shape)}; "
                "compute it from the first image in torch"
            )
        objective = value.sum() + self.ridge * change.square().sum()
        objective.backward()
        return objective


def _pixel_weights(mask: Tensor | None, operator: NonlocalOperator, layers: Tensor) -> Tensor:
    """Weights (B, C, N) or (1, C, N) of the pixels, of unit sum for every image."""
    batch, _, channels, *size = layers.shape
    counted = layers.new_ones(1, 1, math.prod(size))
    if mask is not None:
        check_fits(mask, tuple(size), "mask", "image", channels=1, batch=batch)
        if not is_hidden(mask) and bool((mask < 0).any()):
            raise ValueError(f"mask must be non-negative, got {mask.min().item():g}; clamp it at 0")
        counted = mask.double().flatten(2)
    counted = weighted(counted, operator.weights)
    total = operator.communicator.sum(counted.sum(2, keepdim=True))
    if not is_hidden(counted) and bool((total <= 0).any()):
        raise ValueError(
            "mask must hold a pixel of positive weight for every image, got zeros only; select some pixels"
        )
    return (counted / (channels * total)).expand(-1, channels, -1)
