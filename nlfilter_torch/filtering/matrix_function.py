"""Functions of W itself, from products with W and shifted systems. Paper: eq. (7), (8).

The eigenvectors in the span of the factor do not show what the diagonal part of W does to a pixel unlike all others.
Three methods need no eigenvectors:

- a polynomial of W, if one of low degree fits the response on the range of the eigenvalues;
- a polynomial and poles on the negative axis, if the response has its singularity at or near 0, as a fractional power:
  every pole is a shifted system, which a Gram matrix solves exactly (:mod:`nlfilter_torch.operator.pixel_matrix`);
- the method of Lanczos, for responses with steps or kinks inside the range (:mod:`nlfilter_torch.filtering.lanczos`).

The first that keeps the tolerance is taken. The derivative of the first two is exact, however large the tolerance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import fold_batch, unfold_batch
from nlfilter_torch.core.checks import check_fits, check_instance, check_values, checked_response
from nlfilter_torch.core.precision import Gradients, full_precision, trainable, uncompiled, working_dtype
from nlfilter_torch.core.rational import DECADES, RationalForm, best_form, interval_nodes, pole_forms
from nlfilter_torch.core.torch_internals import in_format_of, is_unreadable
from nlfilter_torch.core.warning import warn
from nlfilter_torch.filtering.lanczos import STEPS, krylov_product, ritz_space
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.pixel_matrix import ROWS, PixelMatrix
from nlfilter_torch.operator.spectrum import Response


def rational_product(matrix: PixelMatrix, planes: Tensor, form: RationalForm, coefficients: Tensor) -> Tensor:
    """``sum_k a_k T_k(2 W - 1) y + sum_j c_j t_j (W + t_j)^-1 y``, (B, C, N).

    Args:
        matrix: W.
        planes: y, (B, C, N).
        form: of the function.
        coefficients: a and c, (B, degree + 1 + J).

    Returns:
        Planes, whose gradient in all arguments is that of this rational function, to rounding. If W needs none,
        differentiable any number of times, also in forward mode.
    """
    shifts = form.shifts.to(planes)
    function = _Rational(form.degree, shifts, matrix.capacitances(shifts))
    if not matrix.needs_gradient:
        return function.value(matrix, planes, coefficients.to(planes))
    return matrix.apply(function, planes, coefficients.to(planes))


def pole_terms(matrix: PixelMatrix, planes: Tensor, form: RationalForm) -> Tensor:
    """``t_j (W + t_j)^-1 y`` for all poles, (B, J, C, N); without a gradient in W."""
    shifts = form.shifts.to(planes)
    return matrix.solve(planes, shifts, matrix.capacitances(shifts))


def weigh_poles(planes: Tensor, terms: Tensor, weights: Tensor) -> Tensor:
    """``w_0 y + sum_j w_j y_j`` for planes y, (B, C, N), terms y_j, (B, J, C, N), and weights (B, 1 + J)."""
    weights = weights.to(planes)[:, :, None, None]
    total = weights[:, 0] * planes
    for j in range(terms.shape[1]):
        total = torch.addcmul(total, weights[:, 1 + j], terms[:, j])
    return total


def _chebyshev(matrix: PixelMatrix, planes: Tensor, degree: int) -> list[Tensor]:
    """``T_k(2 W - 1) y`` for k from 0 to ``degree``."""
    terms = [planes]
    for k in range(degree):
        doubled = 2 * matrix.product(terms[-1]) - terms[-1]  # (2 W - 1) T_k y
        terms.append(doubled if k == 0 else 2 * doubled - terms[-2])
    return terms


@dataclass(frozen=True, eq=False)
class _Rational:
    """The rational function, with the derivative of poles: ``d (W + t)^-1 = -(W + t)^-1 dW (W + t)^-1``.

    Attributes:
        degree: of its polynomial.
        shifts: t, (J,).
        inverses: :meth:`PixelMatrix.capacitances` of these.
    """

    degree: int
    shifts: Tensor
    inverses: Tensor

    def value(self, matrix: PixelMatrix, planes: Tensor, gains: Tensor) -> Tensor:
        """The product with planes; gains are the coefficients of the form."""
        gains = gains[:, :, None, None]
        total = gains[:, 0] * planes
        for k, term in enumerate(_chebyshev(matrix, planes, self.degree)):
            total = torch.addcmul(total, gains[:, k], term) if k else total
        step = max(1, ROWS // planes.shape[1])
        for first in range(0, len(self.shifts), step):  # a few at a time, to save memory
            part = slice(first, first + step)
            solutions = matrix.solve(planes, self.shifts[part], self.inverses[:, part])
            total = total + (gains[:, self.degree + 1 :][:, part] * solutions).sum(1)
        return total

    def gradients(
        self, matrix: PixelMatrix, planes: Tensor, gains: Tensor, grad: Tensor, needed: Sequence[bool]
    ) -> Gradients:
        """All of them, since the terms of all are shared."""
        degree, parts = self.degree, gains[:, :, None, None]
        terms, adjoints = _chebyshev(matrix, planes, degree), _adjoints(matrix.transpose, grad, parts, degree)
        grad_gains = [(grad * term).sum((1, 2)) for term in terms]
        # v_1 = (2 W - 1) v_0 and v_(k+1) = 2 (2 W - 1) v_k - v_(k-1)
        left = [(2 if k == 1 else 4) * adjoints[k] for k in range(1, degree + 1)]
        right, grad_planes = terms[:-1], adjoints[0]
        for j in range(len(self.shifts)):
            shift, inverse = self.shifts[j : j + 1], self.inverses[:, j : j + 1]
            solution = matrix.solve(planes, shift, inverse)[:, 0]
            adjoint = matrix.transpose.solve(parts[:, degree + 1 + j] * grad, shift, inverse)[:, 0]
            grad_gains.append((grad * solution).sum((1, 2)))
            grad_planes = grad_planes + adjoint
            left.append(-adjoint / shift)
            right.append(solution)
        grads: Gradients = (None, None, None)
        if left:
            grads = matrix.gradient(torch.cat(left, dim=1), torch.cat(right, dim=1))
        return *grads, grad_planes, torch.stack(grad_gains, dim=1)


def _adjoints(matrix: PixelMatrix, grad: Tensor, coefficients: Tensor, degree: int) -> list[Tensor]:
    """Gradients of the terms of :func:`_chebyshev` (Clenshaw), for the transpose of its matrix."""
    later = last = torch.zeros_like(grad)  # those of the terms k + 2 and k + 1
    adjoints: list[Tensor] = []
    for k in range(degree, -1, -1):
        current = coefficients[:, k] * grad - later
        if k < degree:
            doubled = 2 * matrix.product(last) - last
            current = current + (doubled if k == 0 else 2 * doubled)
        later, last = last, current
        adjoints.append(current)
    return adjoints[::-1]


TOLERANCE = 3e-4  # default; 0.08 of 255 grey levels
UNSEEN_POLES = 16  # where no value can be read
CHANNELS = 1 << 27  # numbers in the bases of a few channels, which are filtered in turn


@dataclass(frozen=True, eq=False)
class FunctionProduct:
    """``f(W) y`` and what it took.

    Attributes:
        image: (B, C, H, W), in the dtype of y.
        products: number of products with W.
        shifts: number of shifted systems that were solved, each at the cost of a Gram matrix and a product.
        error: estimate of the error. Without a tolerance that is missed, it is at most that: for a rational function
            the largest error of the gain of an eigenvalue, relative to the largest gain, which bounds the norm of the
            error; for Lanczos that of a pixel, relative to the largest gain and value of y. NaN where no value can be
            read.
    """

    image: Tensor
    products: int
    shifts: int
    error: float


@uncompiled
@full_precision
def apply_function(
    operator: NonlocalOperator, image: Tensor, response: Response, *, tolerance: float = TOLERANCE
) -> FunctionProduct:
    """Compute ``f(W) y`` for any response f, with the number of products and the error reached.

    Paper: eq. (7), for the W of this library, with its diagonal part; :func:`spectral_filter` returns the image alone.

    Args:
        operator: W.
        image: y, (B, C, H, W).
        response: f, an elementwise function (B, R) to (B, R) of eigenvalues in [0, 1], in the image's dtype (at least
            float32); may have parameters.
        tolerance: of the error, relative to the largest gain; see :class:`FunctionProduct`. Where values cannot be
            read, as in ``torch.func`` and on fake tensors, a fixed rational function takes the place of f, whose error
            is unknown, and large for responses with steps.

    Returns:
        The product; ``image`` is differentiable in image, operator and the parameters of ``response``, once if the
        operator needs a gradient or the response has steps or kinks.

    Raises:
        TypeError, ValueError: if ``image`` does not fit the operator, ``response`` does not return a finite gain for
            every eigenvalue, or ``tolerance`` is not positive.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(image, num_landmarks=20)
        >>> root = apply_function(operator, image, torch.sqrt)
        >>> twice = apply_function(operator, root.image, torch.sqrt)
        >>> bool((twice.image - operator @ image).abs().max() < 1e-3), root.products < 30, root.error < 3e-4
        (True, True, True)
    """
    check_instance(operator, NonlocalOperator, "operator", "make it with nonlocal_operator")
    check_values(tolerance, "tolerance", "positive")
    response = checked_response(response, dtype=working_dtype(image) if isinstance(image, Tensor) else None)
    check_fits(image, operator.size, "image", "operator", operator.factor, empty=True)
    planes = fold_batch(trainable(image).to(operator.factor), operator.factor.shape[0])
    if planes.numel() == 0:
        return FunctionProduct(image.clone(), 0, 0, 0.0)
    matrix = operator.matrix
    decades, seen = _decades(matrix)
    nodes = interval_nodes(decades).to(planes.device).expand(len(planes), -1)
    values = response(nodes)
    seen = seen and not any(map(is_unreadable, (values, planes)))
    rounding = torch.finfo(torch.promote_types(working_dtype(image), planes.dtype)).eps / 2
    rounding = max(rounding, torch.finfo(planes.dtype).eps / 2, torch.finfo(values.dtype).eps / 2)
    form: RationalForm | None = pole_forms(decades, UNSEEN_POLES)[0]
    error = math.nan
    if seen:
        best = best_form(values, decades, tolerance, rounding)
        form, error = (None, error) if best is None else best
    if form is not None:
        coefficients = form.coefficients(operator.communicator.copy_to_group(values))
        filtered = rational_product(matrix, planes, form, coefficients)
        cost = form.degree, len(form.shifts)
    else:
        filtered, steps, error = _by_lanczos(matrix, planes, response, tolerance, float(values.detach().abs().max()))
        cost = steps, 0
    result = unfold_batch(filtered.unsqueeze(1), image.shape[0], image.shape[2:])[:, 0]
    return FunctionProduct(in_format_of(result, image), *cost, error)


@torch.no_grad()
def _decades(matrix: PixelMatrix) -> tuple[int, bool]:
    """Minus the decimal logarithm of a lower bound of the eigenvalues, and whether it could be read.

    W less its diagonal part r is positive semi-definite, so that no eigenvalue is below the smallest r.
    """
    most = DECADES[matrix.remainder.dtype]
    if is_unreadable(matrix.remainder):
        return most, False
    least = -float(matrix.communicator.max(-matrix.remainder.amin(1)).max())
    return (most if least <= 10.0**-most else min(max(math.ceil(-math.log10(least)), 1), most)), True


def _by_lanczos(
    matrix: PixelMatrix, planes: Tensor, response: Response, tolerance: float, largest: float
) -> tuple[Tensor, int, float]:
    """``f(W) y`` for planes y, (B, C, N), the number of products, and the error; some channels at a time.

    ``largest`` is the largest gain. Warns if the tolerance is missed.
    """
    count = max(1, CHANNELS // (STEPS[0] * len(planes) * planes.shape[2]))
    results, steps, errors = [], 0, [0.0]
    for part in planes.split(count, dim=1):
        space, error = ritz_space(matrix, part.detach(), response, tolerance * largest)
        results.append(krylov_product(matrix, part, response, space))
        steps = max(steps, space.values.shape[2])
        errors.append(error / largest if largest > 0 else error)
    if max(errors) > tolerance:
        warn(
            f"response must be smooth where W has eigenvalues, or be far from them where it has steps, for an error of "
            f"{tolerance:g}, got an estimate of {max(errors):.2g} after {steps} products; "
            "smooth its steps, or pass a larger tolerance"
        )
    return torch.cat(results, dim=1), steps, max(errors)
