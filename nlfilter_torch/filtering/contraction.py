"""How fast proximal gradient descent with the prior W converges, known before its first step.

For a linear A, a step x <- P (x - t A^T (A x - y)) is affine. P, the proximal map, is symmetric with eigenvalues in
[0, 1], and so is M = I - t A^T A with eigenvalues of at most 1 in magnitude if t < 2 / |A|^2. The matrix P M of a step
has the eigenvalues of the symmetric ``N = P^(1/2) M P^(1/2)``, so that its spectral radius, the largest magnitude of
these, is the factor by which each step contracts distances in the norm ``|x| = (x^T P^-1 x)^(1/2)``, and no norm has a
smaller one.

The eigenvalues at both ends are bounded from outside by the method of Lanczos from a random start. After k products
``p(N) b = |b| beta_1 ... beta_k q``, where the roots of the polynomial p are the Ritz values, and q is a unit vector.
With v the eigenvector of an extreme eigenvalue l, ``|p(l)| |v^T b| <= |b| beta_1 ... beta_k``. As p grows beyond its
largest root, l is bounded if ``|v^T b|`` is bounded from below, which for a random b it is with a known probability.
Source: van Dorsselaer, Hochstenbach and van der Vorst, "Computing probabilistic bounds for extreme eigenvalues of
symmetric matrices with the Lanczos method", 2000.

The square root of P is never formed. Lanczos runs on M P in the product z^T P z, for which only P is needed. A start
that is normal in this product would need P^(-1/2); for a normal z, ``v^T b = z^T P^(1/2) v`` is normal, too, with the
deviation ``|P^(1/2) v|``, which is at least ``|l| / |M|``, since ``l v = P^(1/2) M P^(1/2) v`` and P is at most 1.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_tensor
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.warning import warn

Map = Callable[[Tensor], Tensor]

FAILURE = 1e-6  # probability that a bound does not hold
PRODUCTS = 100  # of each run of Lanczos, at most
SHARP = 0.05  # share of |A|^2, or of the distance of the factor from 1, within which bounds are sharp enough
EACH = 5  # products after which the bounds are computed; a divisor of PRODUCTS
BISECTIONS = 60
NEGLIGIBLE_REST = {
    torch.float32: 1e-5,
    torch.float64: 1e-12,
}  # rounding of products, relative to the largest eigenvalue
LINEARITY = {torch.float32: 1e-3, torch.float64: 1e-8}  # rounding of A, relative


@dataclass(frozen=True, eq=False)
class Contraction:
    """The promise of proximal gradient descent before its first step; one entry per image, in float64.

    Attributes:
        factor: largest factor (B,) by which a step contracts distances to the solution, from 0 to 1. Below 1 the
            solution is unique. It is 1 where A and I - W lose the same images, such as a missing pixel that resembles
            no other, or where the bound is not sharp enough to tell.
        at_least: lower bound (B,) of the same factor.
        squared_norm: upper bound (B,) of the largest eigenvalue of A^T A.
        step: t, (B,).
        failure: probability, for each image, that the bounds do not hold.
        products: number of products with A and its transpose that it took.
    """

    factor: Tensor
    at_least: Tensor
    squared_norm: Tensor
    step: Tensor
    failure: float
    products: int


class _Lanczos:
    """Lanczos on M P in the product of P, for a batch of starts (B, ...), with all vectors kept and orthogonalised.

    ``project`` is P; None means the identity. ``mass`` (1 or B, n) weighs the entries of products.
    """

    def __init__(self, apply: Map, project: Map | None, start: Tensor, mass: Tensor) -> None:
        self.apply, self.project, self.mass, self.shape = apply, project, mass, start.shape
        self.plain = start.new_empty(len(start), 0, start[0].numel())  # z_1 to z_k, (B, k, n)
        self.mapped = self.plain  # P z_1 to P z_k
        self.diagonal, self.beside = (start.new_empty(len(start), 0, dtype=torch.float64) for _ in range(2))
        self.length = self._append(start.flatten(1))

    def _append(self, vector: Tensor) -> Tensor:
        """Append a vector (B, n) at unit length; its length (B,), 0 if it is rounding."""
        image = vector if self.project is None else self.project(vector.view(self.shape)).flatten(1)
        square = (self.mass * vector * image).double().sum(1)
        length = square.clamp(min=0.0).sqrt()
        inverse = torch.where(length > 0, length, 1.0).reciprocal().to(vector).unsqueeze(1)
        self.plain = torch.cat([self.plain, (vector * inverse).unsqueeze(1)], dim=1)
        self.mapped = torch.cat([self.mapped, (image * inverse).unsqueeze(1)], dim=1)
        return length

    def advance(self) -> None:
        """One product with M and P more."""
        vector = self.apply(self.mapped[:, -1].view(self.shape)).flatten(1)
        for again in (False, True):
            parts = (self.mapped @ (self.mass * vector).unsqueeze(2)).mT  # (B, 1, k)
            if not again:
                self.diagonal = torch.cat([self.diagonal, parts[:, 0, -1:].double()], dim=1)
            vector = vector - (parts @ self.plain).squeeze(1)
        beside = self._append(vector)
        largest = self.diagonal.abs().amax(1).clamp(min=1e-300)
        ended = (beside <= NEGLIGIBLE_REST[vector.dtype] * largest) | (self.beside == 0).any(1)
        beside = torch.where(ended, 0.0, beside)
        alive = (~ended).to(vector).view(-1, 1, 1)
        self.plain = torch.cat([self.plain[:, :-1], self.plain[:, -1:] * alive], dim=1)
        self.mapped = torch.cat([self.mapped[:, :-1], self.mapped[:, -1:] * alive], dim=1)
        self.beside = torch.cat([self.beside, beside.unsqueeze(1)], dim=1)

    def ritz_values(self) -> Tensor:
        """Those of all products so far, (B, k), ascending; zeros are added where a space is complete."""
        beside = self.beside[:, :-1]
        matrix = torch.diag_embed(self.diagonal) + torch.diag_embed(beside, 1) + torch.diag_embed(beside, -1)
        return torch.linalg.eigvalsh(matrix)

    def level(self, chance: float) -> Tensor:
        """Logarithm (B,) that ``|p(l)|`` does not exceed but with a chance of so much, for a normal start."""
        # A normal number of deviation 1 is below d in magnitude with a probability of at most d sqrt(2 / pi).
        least = chance * math.sqrt(math.pi / 2)
        return self.length.log() + self.beside.log().sum(1) - math.log(least)


def _beyond(ritz: Tensor, level: Tensor, norm: Tensor | None, most: Tensor) -> Tensor:
    """The x above Ritz values (B, k), ascending, at which ``log p(x)`` reaches a level (B,), at most ``most`` (B,).

    With a ``norm`` of M, (B,), the level applies to ``log p(x) + log(x / norm)``.
    """
    low = ritz[:, -1] if norm is None else ritz[:, -1].clamp(min=0.0)
    high = torch.maximum(most, low)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        reached = (middle.unsqueeze(1) - ritz).clamp(min=1e-300).log().sum(1)
        if norm is not None:
            reached = reached + (middle / norm).clamp(min=1e-300).log()
        below = reached < level
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return high


def _check_linear(forward: Map, transpose: Map, like: Tensor, mass: Tensor, generator: torch.Generator) -> None:
    """Warn unless A is linear, and compare it with its transpose in the product of ``mass``, (1 or B, n).

    Raises:
        ValueError: if the transpose is not that of A.
    """
    first, second = (_normal(like, mass, generator) for _ in range(2))
    images = [forward(first), forward(second), forward(first + 2 * second)]
    for image in images:
        check_tensor(image, "forward(x)", "return a tensor")
    tolerance = LINEARITY[like.dtype]
    error = (images[2] - images[0] - 2 * images[1]).norm() / images[2].norm().clamp(min=1e-30)
    if float(error) > tolerance:
        warn(
            f"forward must be linear for a factor of contraction, got a deviation of {float(error):.2g} from it; the "
            "factor is that of its values at random images, and nothing is promised"
        )
    back = transpose(images[1])
    if not isinstance(back, Tensor) or back.shape != like.shape:
        got = tuple(back.shape) if isinstance(back, Tensor) else type(back).__name__
        raise ValueError(
            f"transpose must return images of the shape that forward takes, {tuple(like.shape)}, got {got}; pass the "
            "transpose of forward"
        )
    one = float((images[0].double() * images[1].double()).sum())
    other = float((mass * first.flatten(1) * back.flatten(1)).double().sum())
    size = float(images[0].double().norm() * images[1].double().norm())
    if float(error) <= tolerance and abs(one - other) > tolerance * max(size, 1e-30):
        raise ValueError(
            f"transpose must satisfy (A x)^T y = x^T A^T y for forward A, got {one:.5g} and {other:.5g} for random x "
            "and y; pass the transpose of forward"
        )


def _normal(like: Tensor, mass: Tensor, generator: torch.Generator) -> Tensor:
    """A random image that is normal in the product of ``mass``, (1 or B, n)."""
    deviation = torch.where(mass > 0, mass, torch.inf).rsqrt().view(-1, *like.shape[1:])
    return deviation * torch.randn(like.shape, generator=generator, dtype=torch.float64, device=generator.device).to(
        like
    )


def squared_norm(forward: Map, transpose: Map, start: Tensor, mass: Tensor, failure: float) -> tuple[Tensor, int]:
    """Upper bound (B,) of the largest eigenvalue of A^T A, which fails with that probability, and the products.

    Args:
        forward: A, of images (B, C, ...).
        transpose: A^T.
        start: normal images.
        mass: weights (1 or B, n) of the product of images.
        failure: probability.
    """
    space = _Lanczos(lambda image: transpose(forward(image)), None, start, mass)
    for products in range(1, PRODUCTS + 1):
        space.advance()
        if products % EACH:
            continue
        ritz, level = space.ritz_values(), space.level(failure)
        largest = ritz[:, -1]
        most = largest + (level / products).exp()  # p(x) is at least (x - largest)^k
        bound = _beyond(ritz, level, None, most) + NEGLIGIBLE_REST[start.dtype] * largest.abs()
        if bool((bound - largest <= SHARP * largest).all()):
            break
    return bound, products


@full_precision
@torch.no_grad()
def contraction(
    proximal: Callable[[Tensor, Tensor], Tensor],
    forward: Map,
    transpose: Map,
    like: Tensor,
    strength: Tensor,
    step: Tensor | None,
    failure: float,
    weights: Tensor | None,
    generator: torch.Generator | None,
) -> Contraction:
    """:meth:`NonlocalPrior.contraction`, whose arguments are checked.

    Args:
        proximal: the proximal map of an image and g, (B,).
        forward: A.
        transpose: A^T.
        like: zeros in the shape and format of images.
        strength: weight of the prior, (B,) in float64.
        step: t, (B,) in float64; None takes 1 / |A|^2.
        failure: probability.
        weights: of points, (1 or B, N), or None.
        generator: of the start; None is the same in every call.
    """
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    counted = torch.ones_like(like[:1]) if weights is None else weights.view(-1, 1, *like.shape[2:])
    mass = counted.expand(-1, *like.shape[1:]).flatten(1).to(like)
    _check_linear(forward, transpose, like, mass, generator)
    norm, products = squared_norm(forward, transpose, _normal(like, mass, generator), mass, failure / 3)
    if bool((norm <= 0).any()):
        raise ValueError("forward must not be zero for all images, got zeros; pass the map from images to measurements")
    step = norm.reciprocal() if step is None else step
    if bool((step * norm >= 2).any()):
        worst = int((step * norm).argmax())
        raise ValueError(
            f"step must be below 2 / |A|^2, {float(2 / norm[worst]):.4g}, got {float(step[worst]):.4g}; lower it, or "
            "pass None"
        )
    scaled = step.to(like).view(-1, *[1] * (like.ndim - 1))
    space = _Lanczos(
        lambda image: image - scaled * transpose(forward(image)),
        lambda image: proximal(image, (step * strength).to(like)),
        _normal(like, mass, generator),
        mass,
    )
    below = (step * norm - 1).clamp(min=0.0)  # the smallest eigenvalue of M is at least minus this
    for count in range(1, PRODUCTS + 1):
        space.advance()
        if count % EACH:
            continue
        ritz, level = space.ritz_values(), space.level(failure / 3)
        highest = _beyond(ritz, level, torch.ones_like(norm), torch.ones_like(norm))
        lowest = _beyond(-ritz.flip(1), level, torch.ones_like(norm), below)
        at_least = torch.maximum(ritz[:, -1], -ritz[:, 0])
        factor = torch.maximum(highest, lowest)
        if bool((factor - at_least <= SHARP * (1 - at_least)).all()):
            break
    factor = (factor + NEGLIGIBLE_REST[like.dtype]).clamp(max=1.0)
    return Contraction(factor, at_least.clamp(0.0, 1.0), norm, step, failure, products + count)
