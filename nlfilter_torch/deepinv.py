"""The filter as a prior and a denoiser of deepinv, which is optional: ``pip install nlfilter-torch[deepinv]``.

deepinv's algorithms call ``prior.prox(x, *parameters, gamma=...)``, ``prior.grad(x, *parameters)`` and
``denoiser(x, sigma)``; see its classes ``Prior`` and ``Denoiser``. The parameters of an algorithm for its prior are
ignored by :class:`Prior`, since W is given.
"""

from typing import Any

import deepinv
import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_instance, check_values
from nlfilter_torch.core.precision import per_image, working_dtype
from nlfilter_torch.nn.prior import NonlocalPrior
from nlfilter_torch.operator.build import nonlocal_operator

PRIOR_STRENGTH = 1.0  # best of five at a noise of 0.1, on the astronaut of scikit-image


class Prior(deepinv.optim.Prior):
    """A :class:`~nlfilter_torch.NonlocalPrior` as a ``Prior`` of deepinv, with its exact proximal map.

    Args:
        prior: the prior; with the form ``"plug-and-play"``, algorithms that need its energy or gradient are refused.

    Raises:
        TypeError: if ``prior`` is none.
    """

    def __init__(self, prior: NonlocalPrior) -> None:
        super().__init__()
        check_instance(prior, NonlocalPrior, "prior", "make it with NonlocalPrior(operator)")
        self.prior = prior
        self.explicit_prior = prior.form == "red"

    def fn(self, x: Tensor, *_: Any, **__: Any) -> Tensor:
        """The energy of images (B, C, H, W), (B,)."""
        return self.prior.energy(x)

    def grad(self, x: Tensor, *_: Any, **__: Any) -> Tensor:
        """The gradient of the energy, (B, C, H, W)."""
        return self.prior.gradient(x)

    def prox(self, x: Tensor, *_: Any, gamma: float | Tensor = 1.0, **__: Any) -> Tensor:
        """The proximal map of images (B, C, H, W), for gamma a number or (B,), or (B, 1, 1, 1)."""
        return self.prior.prox(x, gamma)


class Denoiser(deepinv.models.Denoiser):
    """W as a ``Denoiser`` of deepinv: the filter of the noisy image itself, or of a guide, applied once.

    Its bandwidth follows the noise. For the trained network pass :class:`~nlfilter_torch.NonlocalDenoiser` itself.

    Args:
        strength: photometric bandwidth in units of sigma, positive.
        guide: (B, C, H, W), in place of the noisy image, or None.
        options: other options of :func:`~nlfilter_torch.nonlocal_operator`.
    """

    def __init__(self, strength: float = PRIOR_STRENGTH, guide: Tensor | None = None, **options: Any) -> None:
        super().__init__()
        check_values(strength, "strength", "positive")
        self.strength, self.options = strength, options
        self.register_buffer("guide", guide, persistent=False)

    def forward(self, x: Tensor, sigma: float | Tensor, **_: Any) -> Tensor:
        """Filter images (B, C, H, W) with noise of standard deviation sigma, a number or (B,); 0 changes nothing."""
        check_values(sigma, "sigma", "not negative", len(x), "0 changes nothing")
        level = per_image(sigma, x.new_empty(0, dtype=working_dtype(x)), 1)
        noisy = level > 0
        bandwidth = self.strength * torch.where(noisy, level, 1.0)
        guide = x if self.guide is None else self.guide
        filtered = nonlocal_operator(guide, photometric_bandwidth=bandwidth, **self.options) @ x
        return torch.where(noisy.view(-1, 1, 1, 1), filtered, x)
