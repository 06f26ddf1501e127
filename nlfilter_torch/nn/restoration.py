"""Restoring images from linear measurements by proximal gradient descent with the prior W."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_image, check_instance, check_tensor, check_values
from nlfilter_torch.core.precision import per_image, working_dtype
from nlfilter_torch.filtering.contraction import Contraction, Map
from nlfilter_torch.nn.prior import NonlocalPrior


@dataclass(frozen=True, eq=False)
class Restoration:
    """A restored image, and how it came about.

    Attributes:
        image: (B, C, H, W).
        prior: the prior of the last step.
        contraction: what was promised for the steps with that prior, before the first of them.
        changes: root mean squares (k,) of the changes of all steps, over the whole batch, in float64.
    """

    image: Tensor
    prior: NonlocalPrior
    contraction: Contraction
    changes: Tensor


def restore(
    observed: Tensor,
    forward: Map,
    transpose: Map,
    prior: NonlocalPrior | Callable[[Tensor], NonlocalPrior],
    *,
    strength: float | Tensor,
    start: Tensor | None = None,
    step: float | Tensor | None = None,
    steps: int = 100,
    renewals: int = 1,
    tolerance: float = 0.0,
) -> Restoration:
    """Restore an image from measurements, by proximal gradient descent with W as the prior.

    Each step is ``x <- prox(x - t A^T (A x - y), t strength)``; with the form ``"red"`` the limit minimises
    ``|A x - y|^2 / 2 + strength x^T (I - W) x / 2``. With a prior that is given, W is frozen, and the contraction
    factor is computed before the first step. With a function that makes a prior of the current image, W is renewed
    before each of the first ``renewals`` steps, for which no factor is promised, and frozen from then on; the factor is
    that of the frozen W. Source: Combettes and Wajs, "Signal recovery by proximal forward-backward splitting", 2005.

    Args:
        observed: y, the measurements.
        forward: A, a function of images (B, C, H, W) that acts on each image alone.
        transpose: A^T, from measurements to images.
        prior: a prior, or a function that makes one of an image (B, C, H, W).
        strength: weight of the prior, a number or a tensor of shape () or (B,), positive and finite.
        start: the first image (B, C, H, W); None takes ``A^T y``. It should fill what A loses, for a prior of it.
        step: t, below ``2 / |A|^2``, likewise; None takes ``1 / |A|^2``.
        steps: number of steps, at most.
        renewals: number of steps before which a function makes a new prior.
        tolerance: the descent ends when a step with the frozen W changes the root mean square of the images by no more
            than this.

    Returns:
        The image and the promise. Differentiable in measurements and start, through all steps.

    Raises:
        TypeError, ValueError: if an argument is not of this kind; see also :meth:`NonlocalPrior.contraction`.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> rows, columns = torch.meshgrid(*[torch.linspace(0, 6, 24)] * 2, indexing="ij")
        >>> image = (0.5 + 0.4 * torch.sin(rows) * torch.sin(columns))[None, None]
        >>> known = (torch.rand(image.shape, generator=torch.Generator().manual_seed(0)) < 0.5).float()
        >>> mask = lambda x: known * x
        >>> guide = torch.where(known > 0, image, image[known > 0].mean())
        >>> make = lambda x: NonlocalPrior(nonlocal_operator(x, num_landmarks=50, spatial_bandwidth=2.0))
        >>> restored = restore(known * image, mask, mask, make, strength=0.1, start=guide, renewals=3)
        >>> bool((restored.image - image).square().mean() < (guide - image).square().mean() / 4)
        True
        >>> bool(restored.contraction.factor < 1)
        True
    """
    check_tensor(observed, "observed")
    check_count(steps, "steps")
    check_count(renewals, "renewals")
    check_values(tolerance, "tolerance", "not negative", remedy="0.0 takes all steps")
    image = transpose(observed) if start is None else start
    check_image(image, "start" if start is not None else "transpose(observed)", dimensions=(4, 5))
    image = image.to(working_dtype(image))
    channels, changes = image.shape[1], list[Tensor]()
    current = prior if isinstance(prior, NonlocalPrior) else prior(image)
    check_instance(current, NonlocalPrior, "prior", "pass one, or a function that returns one")
    promise = current.contraction(forward, transpose, strength=strength, step=step, channels=channels)
    rate = promise.step
    for number in range(steps):
        if not isinstance(prior, NonlocalPrior) and 0 < number < renewals:
            current = prior(image)
            if number == renewals - 1:
                promise = current.contraction(forward, transpose, strength=strength, step=rate, channels=channels)
        error = transpose(forward(image) - observed)
        moved = image - per_image(rate, image, image.ndim) * error
        following = current.prox(moved, (rate * torch.as_tensor(strength).to(rate).reshape(-1)).to(image))
        changes.append((following - image).detach().double().square().mean().sqrt())
        image = following
        if number >= renewals - 1 and bool(changes[-1] <= tolerance):
            break
    return Restoration(image, current, promise, torch.stack(changes))
