"""The squared error of a filter without the truth: Stein's unbiased risk estimate.

For y = x + n with normal noise n of covariance V, the mean of ``|f(y) - x|^2`` is that of ``|f(y) - y|^2 - tr V +
2 tr(V J)`` with the derivative J of f. Of W, which is low rank plus diagonal, the trace is exact: with
``W = F^T F' + R``, where F' is F times the weights of the points, powers are ``W^k = R W^(k-1) + F^T P_(k-1)`` and
``P_k = F' W^k`` is a sum of ``C_(k-j) F' R^j`` with small matrices C, so that Gram matrices of F give all traces. Other
functions are probed by random fields with the covariance of the noise.
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import root_weighted, weighted
from nlfilter_torch.core.checks import (
    check_alpha,
    check_count,
    check_fits,
    check_image,
    check_instance,
    check_number,
    check_positive,
    check_shape,
    check_tensor,
)
from nlfilter_torch.core.kernels.tall_skinny import compute_grams
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.filtering.filters import detail_layers, polynomial_filter
from nlfilter_torch.filtering.noise import NoiseModel, drawn, variance_of
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import SUMMED_EXACTLY

Noise = float | Tensor | NoiseModel
Build = Callable[[Tensor], NonlocalOperator]
# Step of differences, in units of the noise: large beside the rounding of single precision and the tolerance of the
# balancing, small beside a bandwidth. Errors of first order in the step cancel, since probes are symmetric about 0.
STEP = 0.05


@full_precision
def sure(
    function: Callable[[Tensor], Tensor] | NonlocalOperator,
    image: Tensor,
    noise: Noise,
    *,
    alpha: Tensor | None = None,
    step: float | None = None,
    probes: int = 1,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Estimate the mean squared error of a filtered image without knowing the truth.

    Stein, "Estimation of the Mean of a Multivariate Normal Distribution", 1981; by random probes after Ramani, Blu and
    Unser, "Monte-Carlo SURE", 2008. Unbiased for normal noise of known strength and a function without jumps. k-means
    jumps: a function that builds W from the noisy image must hold its landmarks (``landmarks=operator``). The estimate
    deviates by about the noise variance times sqrt(2 / P), of P values: use whole pictures.

    Args:
        function: takes an image (B, C, H, W) and returns one of its shape, each from its own image alone. Or an
            operator that does not depend on the image, for which the trace is exact.
        image: (B, C, H, W), noisy.
        noise: standard deviation of white noise in units of the image: a number, (B,), or a map (B, 1 or C, H, W); or a
            :class:`~nlfilter_torch.NoiseProfile`, of noise that is correlated. A constant for gradients.
        alpha: sliders (k+1,) or (B, k+1) of :func:`polynomial_filter` with the operator; None is W itself.
        step: None takes the derivative of the function from autograd, and the estimate has no gradient. A number, such
            as 0.05, takes differences over so many standard deviations of the noise, at the cost of one more call for
            each probe: for functions outside torch, and for an estimate that is differentiable in their parameters.
        probes: number of random fields, each of which probes the function in all pixels at once.
        generator: of the probes; None draws the same in every call.

    Returns:
        (B,), in squared units of the image, in its dtype; it may be negative. With an operator differentiable in
        operator, image and sliders.

    Raises:
        TypeError, ValueError: if an argument has the wrong type or shape, ``noise`` is negative, ``alpha`` is given
            without an operator, or the result of the function does not depend on its argument in torch's graph.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> clean = torch.linspace(0, 1, 64).expand(1, 1, 64, 64)
        >>> noisy = clean + 0.1 * torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(clean, num_landmarks=20)
        >>> true = (operator @ noisy - clean).square().mean()
        >>> bool((sure(operator, noisy, 0.1) - true).abs() < 5e-4)
        True
    """
    check_image(image, "image", dimensions=(4, 5, 3))
    check_count(probes, "probes")
    if step is not None:
        check_number(step, "step", "pass 0.05 or None")
        check_positive(step, "step")
    y = image.to(working_dtype(image))
    values = y[0].numel()
    variance = variance_of(noise, y).expand_as(y)
    if isinstance(function, NonlocalOperator):
        check_fits(image, function.size, "image", "operator", function.factor)
        sliders = y.new_tensor([0.0, 1.0]) if alpha is None else alpha
        check_alpha(sliders, dimensions=(1, 2))
        output = polynomial_filter(function, y, sliders)
        order = sliders.shape[-1] - 1
        divergence = layer_divergences(function, y, noise, None, order, probes=probes, generator=generator)
        divergence = (sliders.to(divergence) * divergence).sum(1)
    elif not callable(function):
        raise TypeError(
            f"function must be an operator or a function of an image, got {type(function).__name__}; pass one of these"
        )
    elif alpha is not None:
        raise ValueError("alpha must be None unless function is an operator, got sliders; apply them in the function")
    elif step is None:
        output, divergence = _by_autograd(function, y, noise, probes, generator)
    else:
        output, divergence = _by_differences(function, y, noise, step, probes, generator)
    error = (output - y).double().square().flatten(1).sum(1) - variance.double().flatten(1).sum(1) + 2 * divergence
    most = torch.finfo(image.dtype).max  # squares of large values have no number in float32
    return (error / values).clamp(-most, most).to(image.dtype)


def _generator(generator: torch.Generator | None) -> torch.Generator:
    if generator is None:
        return torch.Generator().manual_seed(0)
    check_instance(generator, torch.Generator, "generator", "create one with torch.Generator()")
    return generator


def _called(function: Callable[[Tensor], Tensor], image: Tensor) -> Tensor:
    output = function(image)
    check_tensor(output, "function", "return a tensor")
    check_shape(output, tuple(image.shape), "the result of function", "return an image of the same shape")
    return output


def _by_autograd(
    function: Callable[[Tensor], Tensor], image: Tensor, noise: Noise, probes: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """The result, and ``tr(V J)`` (B,), without gradients."""
    random, total = _generator(generator), image.new_zeros(len(image), dtype=torch.float64)
    with torch.enable_grad():
        traced = image.detach().clone().requires_grad_()
        output = _called(function, traced)
        if not output.requires_grad:
            raise ValueError(
                "function must compute its result from the image in torch, got one without a gradient; pass step=0.05 "
                "to take differences"
            )
        for number in range(probes):
            probe = drawn(noise, traced, random)
            (pulled,) = torch.autograd.grad(
                output, traced, probe.to(output), retain_graph=number + 1 < probes, materialize_grads=True
            )
            total = total + (probe * pulled).double().flatten(1).sum(1)
    return output.detach(), total / probes


def _by_differences(
    function: Callable[[Tensor], Tensor],
    image: Tensor,
    noise: Noise,
    step: float,
    probes: int,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """The result, and ``tr(V J)`` (B,), with gradients in the parameters of the function."""
    random, output = _generator(generator), _called(function, image)
    total = torch.zeros(len(image), dtype=torch.float64, device=image.device)
    for _ in range(probes):
        probe = drawn(noise, image, random)
        change = _called(function, image + step * probe) - output
        total = total + (probe * change / step).double().flatten(1).sum(1)
    return output, total / probes


def layer_divergences(
    operator: NonlocalOperator | Build,
    image: Tensor,
    noise: Noise,
    weights: Tensor | None,
    order: int,
    *,
    probes: int = 1,
    generator: torch.Generator | None = None,
) -> Tensor:
    """``tr(Omega V J_i)`` (B, k+1) of the detail layers of an image (B, C, H, W), in float64.

    Args:
        operator: W, or a function that builds it from the image, whose dependence on the noise then counts.
        image: in the operator's dtype.
        noise: as for :func:`sure`.
        weights: Omega, (B or 1, C, N); None means 1 each.
        order: k.
        probes: number of random fields, unless W is given and the noise is white: then the trace is exact.
        generator: of the probes.
    """
    if isinstance(operator, NonlocalOperator) and not isinstance(noise, NoiseModel):
        variance = variance_of(noise, image).flatten(2).double()
        variance = variance.expand(-1, image.shape[1], -1)
        shares = (variance if weights is None else weights * variance).sum(1)
        return _layer_traces(operator, shares, order)
    random, total = _generator(generator), torch.zeros((), dtype=torch.float64, device=image.device)
    before = image if isinstance(operator, NonlocalOperator) else detail_layers(operator(image), image, order=order)
    for _ in range(probes):
        probe = drawn(noise, image, random)
        if isinstance(operator, NonlocalOperator):
            operator.communicator.check_whole("noise that is not white")
            change = detail_layers(operator, probe, order=order)
        else:
            moved = image + STEP * probe
            change = (detail_layers(operator(moved), moved, order=order) - before) / STEP
        products = (probe.unsqueeze(1) * change).double().flatten(3)  # (B, k+1, C, N)
        total = total + (products if weights is None else weights.unsqueeze(1) * products).sum((2, 3))
    return total / probes


def _layer_traces(operator: NonlocalOperator, shares: Tensor, order: int) -> Tensor:
    """``tr(diag(s) J_i)`` (B, k+1) of the layers of W with s = ``shares`` (B, N), not negative, in float64."""
    matrix, summed = operator.matrix, operator.communicator.sum
    exact = operator.communicator.pixels(matrix.factor.shape[2]) <= SUMMED_EXACTLY
    batch = max(len(matrix.factor), len(shares))
    factor, scaling, remainder = (part.expand(batch, *part.shape[1:]) for part in matrix.parts[:3])
    # The traces are linear in shares, which may be too large for float32.
    largest = operator.communicator.max(shares.amax(1, keepdim=True))
    shares = (shares / torch.where(largest > 0, largest, 1.0)).expand(batch, -1)
    total = weighted(shares, operator.weights)

    def grams(weights: Tensor | None) -> Tensor:
        root = root_weighted(scaling, None if weights is None else weights.to(scaling))
        return summed(compute_grams(factor, root, remainder, order, exact=exact))

    own, of_shares = grams(operator.weights), grams(total)  # (B, k, M, M)
    small = [torch.eye(factor.shape[1], dtype=torch.float64, device=factor.device).expand(batch, -1, -1)]
    for power in range(1, order):
        small.append(torch.stack([small[power - 1 - j] @ own[:, j] for j in range(power)]).sum(0))
    alone = remainder.double().unsqueeze(1).pow(torch.arange(order + 1, device=factor.device).view(1, -1, 1))
    traces = [summed(row) for row in (alone * shares.unsqueeze(1)).sum(2).unbind(1)]
    for power in range(1, order + 1):
        for m in range(power):
            inner = (small[m].mT * of_shares[:, power - 1 - m]).sum((1, 2))
            traces[power] = traces[power] + (power - m) * inner
    return largest * torch.stack([before - after for before, after in pairwise(traces)] + traces[-1:], dim=1)
