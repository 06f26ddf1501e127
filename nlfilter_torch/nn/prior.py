"""W as a prior of images: a layer with the terms that methods of restoration ask for."""

from collections.abc import Callable
from typing import Self, get_args

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_choice, check_count, check_instance, check_number, check_positive
from nlfilter_torch.core.precision import per_image
from nlfilter_torch.filtering.contraction import FAILURE, Contraction, Map, contraction
from nlfilter_torch.filtering.prior import Form, Kept, energy, proximal_map
from nlfilter_torch.operator.operator import NonlocalOperator


class NonlocalPrior(nn.Module):
    """The prior that W is of images: energy, gradient and proximal map, for methods that restore images.

    With ``form="red"`` the energy is ``x^T (I - W) x / 2``, which is small for images that the filter leaves as they
    are; its gradient is ``(I - W) x`` and its proximal map ``(I + g (I - W))^-1``. With ``form="plug-and-play"`` the
    filter itself is the proximal map for g = 1, and that for any g is ``W ((1 - g) W + g)^-1``. The energy of that
    form, ``x^T (W^-1 - I) x / 2``, is infinite outside the range of W and is not offered, nor is its gradient.

    W has eigenvalues in [0, 1], so that both energies are convex and both maps firmly nonexpansive. The maps are
    computed directly, to rounding, by one M x M matrix for each g and two reads of the factor. With an operator of
    weighted points, W is symmetric in their product, and energy, gradient and map are those of this product.

    Source: Romano, Elad and Milanfar, 2017 (RED); Venkatakrishnan, Bouman and Wohlberg, 2013 (plug and play).

    Args:
        operator: W, of one image or of a batch; usually of a first estimate of the image that is sought.
        form: ``"red"`` or ``"plug-and-play"``.

    Raises:
        TypeError, ValueError: if ``operator`` is no operator, or ``form`` is another word.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> prior = NonlocalPrior(nonlocal_operator(image, num_landmarks=20))
        >>> near = prior.prox(image, 2.0)
        >>> torch.allclose(near + 2 * prior.gradient(near), image, atol=1e-5)
        True
        >>> bool(prior.energy(near) < prior.energy(image))
        True
    """

    def __init__(self, operator: NonlocalOperator, form: Form = "red") -> None:
        super().__init__()
        check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
        check_choice(form, "form", get_args(Form))
        self.operator = operator
        self.form: Form = form
        self._kept: list[Kept] = []

    def energy(self, x: Tensor) -> Tensor:
        """Compute ``x^T (I - W) x / 2``.

        Args:
            x: (B, C, H, W) of the operator's size, or its other shapes; see :meth:`NonlocalOperator.matmul`.

        Returns:
            (B,), in the image's dtype, at least 0 up to rounding. Differentiable in x and the operator.

        Raises:
            TypeError, ValueError: if ``x`` does not fit the operator, or the form is ``"plug-and-play"``.
        """
        self._check_energy("energy")
        return energy(self.operator, x)

    def gradient(self, x: Tensor) -> Tensor:
        """Compute ``(I - W) x``, the gradient of the energy, in the shape and dtype of x; see :meth:`energy`."""
        self._check_energy("gradient")
        return x - self.operator @ x

    def prox(self, x: Tensor, g: float | Tensor) -> Tensor:
        """Compute the proximal map: the z that minimises ``g energy(z) + |z - x|^2 / 2``.

        Args:
            x: (B, C, H, W) of the operator's size, or its other shapes.
            g: weight of the energy, a number or a tensor of shape () or (B,), finite and at least 0; 0 is the identity.
                At most 1e5 in float32 and 1e12 in float64, for the eigenvalues of W have rounding errors.

        Returns:
            The shape and dtype of x. Differentiable in x, the operator and g; where g is 0, not in these two.

        Raises:
            TypeError, ValueError: if ``x`` does not fit the operator, or ``g`` is negative, not finite or too large.
        """
        return proximal_map(self.operator, x, g, self.form, self._kept)

    def contraction(
        self,
        forward: Map,
        transpose: Map,
        *,
        strength: float | Tensor = 1.0,
        step: float | Tensor | None = None,
        channels: int = 1,
        failure: float = FAILURE,
        generator: torch.Generator | None = None,
    ) -> Contraction:
        """Bound the factor by which each step of proximal gradient descent contracts, before the first step.

        A step is ``x <- prox(x - t A^T (A x - y), t strength)``; see :func:`restore`. The factor is below 1 only if no
        image but 0 is lost by both A and I - W. It holds while W is the same, and is no promise where A is not linear,
        which causes a warning. The eigenvalues that it depends on are bounded by the method of Lanczos from a random
        start, which keeps two images for each of its at most 100 products. Source: van Dorsselaer, Hochstenbach and
        van der Vorst, 2000.

        Args:
            forward: A, a function of images (B, C, H, W) of the operator's size that acts on each image alone and
                returns measurements of any shape.
            transpose: A^T, from measurements to images: the adjoint of A in the product of images, in which points
                count by their weights if the operator has any.
            strength: weight of the energy, a number or a tensor of shape () or (B,), positive and finite.
            step: t, below ``2 / |A|^2``, likewise; None takes ``1 / |A|^2``, with the upper bound of the norm.
            channels: C of the images that ``forward`` takes.
            failure: probability that the bounds do not hold, between 0 and 1.
            generator: of the random start, on the CPU; None draws the same in every call.

        Returns:
            The bounds, for each image. Without a gradient.

        Raises:
            TypeError, ValueError: if an argument is not of this kind, ``transpose`` is not that of ``forward``, or
                ``step`` is too long.

        Example:
            >>> from nlfilter_torch import nonlocal_operator
            >>> image = torch.rand(1, 1, 24, 24, generator=torch.Generator().manual_seed(0))
            >>> known = (image > 0.3).float()
            >>> prior = NonlocalPrior(nonlocal_operator(image, num_landmarks=20, photometric_bandwidth=0.5))
            >>> found = prior.contraction(lambda x: known * x, lambda y: known * y, strength=0.5)
            >>> bool(0.5 < found.factor < 1), round(float(found.squared_norm), 3)
            (True, 1.0)
        """
        for name, function in (("forward", forward), ("transpose", transpose)):
            if not callable(function):
                raise TypeError(
                    f"{name} must be a function of a tensor, got {type(function).__name__}; pass a function"
                )
        batch, operator = len(self.operator), self.operator
        operator.communicator.check_whole("a factor of contraction")
        check_positive(strength, "strength", batch)
        if step is not None:
            check_positive(step, "step", batch)
        check_count(channels, "channels")
        check_number(failure, "failure")
        if not 0 < failure < 1:
            raise ValueError(f"failure must be between 0 and 1, got {failure}; pass 1e-6 for near certainty")
        each = torch.ones(batch, dtype=torch.float64, device=operator.device)
        return contraction(
            self.prox,
            forward,
            transpose,
            operator.factor.new_zeros(batch, channels, *operator.size),
            each * per_image(strength, each, 1),
            None if step is None else each * per_image(step, each, 1),
            failure,
            operator.weights,
            generator,
        )

    def forward(self, x: Tensor, g: float | Tensor) -> Tensor:
        """Compute :meth:`prox`."""
        return self.prox(x, g)

    def extra_repr(self) -> str:
        """The operator and the form."""
        return f"{self.operator}, form={self.form!r}"

    def _check_energy(self, name: str) -> None:
        if self.form != "red":
            raise ValueError(
                f"form must be 'red' for the {name}, got {self.form!r}, whose energy is infinite outside the range of "
                "W; use prox, or NonlocalPrior(operator)"
            )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the operator with the layer."""
        moved: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        like = fn(self.operator.factor.detach()[:0])
        self.operator = self.operator.to(like.device, like.dtype)
        self._kept.clear()
        return moved
