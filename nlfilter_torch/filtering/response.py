"""The sliders' response f(lambda), a polynomial in the eigenvalues. Paper: Sec. III, eq. (14), Fig. 6."""

from torch import Tensor

from nlfilter_torch.core.checks import check_alpha, check_eigenvalues


def polynomial_response(eigenvalues: Tensor, alpha: Tensor) -> Tensor:
    """Gain of every eigenvalue under the sliders ``alpha``: f(0) = alpha_1 and f(1) = alpha_{k+1}.

    Paper: eq. (14), in the form ``sum_i alpha_i lambda^(i-1) (1 - lambda) + alpha_{k+1} lambda^k``.

    Args:
        eigenvalues: (..., R), usually in [0, 1].
        alpha: (k+1,) or (B, k+1) with ``eigenvalues`` (B, R); fine to coarse, at least two entries.

    Returns:
        (..., R), differentiable in both.

    Raises:
        TypeError, ValueError: if ``alpha`` is not a floating-point tensor of such a shape with at least two entries.

    Example:
        >>> import torch
        >>> polynomial_response(torch.tensor([0.0, 0.5, 1.0]), torch.tensor([3.0, 1.0, 1.0, 1.5]))
        tensor([3.0000, 2.0625, 1.5000])
    """
    check_eigenvalues(eigenvalues)
    check_alpha(alpha, dimensions=(1, 2))
    weights = alpha.to(eigenvalues)
    gain = weights[..., -1:]  # Horner's scheme from the coarsest layer down
    for i in range(weights.shape[-1] - 2, -1, -1):
        gain = weights[..., i : i + 1] + eigenvalues * (gain - weights[..., i : i + 1])
    return gain
