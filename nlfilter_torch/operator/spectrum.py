"""Spectrum of W by the Rayleigh-Ritz method in the span of the factor. Paper: Sec. II-A to II-C, eq. (3), (4).

With ``F`` (M, N) the scaled factor and ``G = F F^T``, the rows of ``G^(-1/2) F`` are orthonormal, and W projected onto
their span is ``T = G^(-1/2) (G^2 + F diag(r) F^T) G^(-1/2)``. G and T are M x M matrices in float64. The factor is read
twice: once for G, and once to form or apply eigenvectors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import torch
from torch import Tensor
from torch.nn.functional import pad

from nlfilter_torch.core.blocks import fold_batch, root_weighted, unfold_batch, weighted
from nlfilter_torch.core.checks import check_coefficients, check_fits, check_instance, checked_response, spelled
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.containers import Batch, loadable
from nlfilter_torch.core.kernels.tall_skinny import compute_grams, moment, spread
from nlfilter_torch.core.precision import full_precision, trainable
from nlfilter_torch.core.symmetric_matrix import SymmetricMatrix
from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.operator.pixel_matrix import Columns, PixelMatrix

# Eigenvalues of G below this, relative to the largest, are rounding errors.
CUT = {torch.float32: 1e-5, torch.float64: 1e-9}
# If the inverse eigenvalues of G sum to more than this, eigenvectors from sums in float32 are not orthogonal enough.
WEAK = 3e3
# Eigenvalues this close to 1 count as 1 when the constant vector is selected from their eigenspace.
CLUSTER = {torch.float32: 1e-3, torch.float64: 1e-8}

Response = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class RitzPairs:
    """Matrices from sums over pixels, which together with the factor determine functions of W.

    Attributes:
        ritz: T, (B, M, M), float64.
        root: G^(-1/2), (B, M, M), float64.
        support: (B, M) bool, which eigenvalues of T are above rounding.
    """

    ritz: SymmetricMatrix
    root: Tensor
    support: Tensor

    @staticmethod
    def of_sums(grams: Tensor, dtype: torch.dtype) -> "RitzPairs":
        """Compute the matrices from ``F F^T`` and, if W has a diagonal part, ``F diag(r) F^T``: (B, 1 or 2, M, M).

        The sums are in float64; ``dtype`` is that of the factor, which determines their rounding error.
        """
        gram = SymmetricMatrix.of(grams[:, 0])
        kept = gram.eigenvalues > CUT[dtype] * gram.eigenvalues[:, :1]
        root = gram.apply(torch.rsqrt, kept)
        # G^(-1/2) G^2 G^(-1/2) is the kept part of G; the product would lose its smallest eigenvalues to rounding.
        projected = gram.apply(lambda values: values, kept) + root @ grams[:, 1:].sum(1) @ root
        ritz = SymmetricMatrix.of((projected + projected.mT) / 2)
        ritz = replace(ritz, eigenvalues=ritz.eigenvalues.clamp(max=1.0))
        return RitzPairs(ritz, root, torch.arange(kept.shape[1], device=kept.device) < kept.sum(1, keepdim=True))

    def basis(self, response: Response) -> Tensor:
        """``B = f(T) G^(-1/2)``, (B, M, M) in float64; ``B^T B`` is the core of ``f(W)^2``."""
        return self.ritz.apply(response, self.support) @ self.root

    def gain(self, response: Response) -> Tensor:
        """Core ``X = G^(-1/2) f(T) G^(-1/2)`` of ``f(W) = F^T X F``, (B, M, M) in float64.

        Args:
            response: f, an elementwise differentiable function of the eigenvalues, (B, R) to (B, R).

        Returns:
            X, independent of the choice of eigenvectors; differentiable in the operator and the parameters of f.

        Raises:
            TypeError, ValueError: if ``response`` does not return a finite gain for every eigenvalue.
        """
        return self.root @ self.basis(checked_response(response, self.support))


@dataclass(frozen=True, eq=False, repr=False)
class Spectrum(Batch, RitzPairs):
    """Leading eigenvalues and eigenvectors of a :class:`NonlocalOperator`. Paper: eq. (3), (4).

    Made by :meth:`NonlocalOperator.spectrum`. Eigenvectors are formed when first used. Filters and masks do not need
    them, since :meth:`gain` gives any f(W) through M x M matrices. Spectra are values like operators: ``spectrum[0]``
    selects an image, ``cat`` joins spectra, and ``to`` and ``detach`` return new ones.

    Attributes:
        eigenvalues: (B, R), descending, in [0, 1]; padded with zeros if the images of a batch differ in rank, and to
            R = M on accelerators, where reading the rank would stall the queue. Their gradient is exact, also for
            repeated eigenvalues.
        ritz: T, (B, M, M), float64.
        root: G^(-1/2), (B, M, M), float64.
        support: (B, M) bool, which eigenvalues of T are above rounding.
        factor: (B, M, N), before scaling.
        scaling: d, (B, N).
        size: (H, W), or that of the operator.
        largest: the first eigenvalue before it was clamped to 1, (B,).
        residual: that of the operator, (B,).
        weights: number of pixels that each point represents, (B, N), or None. Eigenvectors are orthonormal in the sum
            over points with these weights.
        communicator: ranks that the rows of the image are distributed over.
        remainder: r, the diagonal part of W, (B, N), or None if it has none.
    """

    eigenvalues: Tensor
    factor: Tensor
    scaling: Tensor
    size: tuple[int, ...]
    largest: Tensor
    residual: Tensor
    weights: Tensor | None = None
    communicator: Communicator = ALONE
    remainder: Tensor | None = None

    def __repr__(self) -> str:
        images = len(self)
        return (
            f"Spectrum({images} image{'' if images == 1 else 's'} of {spelled(self.size)}, "
            f"{self.eigenvalues.shape[1]} eigenvalues, {self.dtype}, {self.device})"
        )

    @classmethod
    def alike(cls, batches: Sequence[Self]) -> Sequence[Self]:
        """The spectra, with equally many eigenvalues, and with weights if one of them has these."""
        rank = max(spectrum.eigenvalues.shape[1] for spectrum in batches)
        weighted = any(spectrum.weights is not None for spectrum in batches)
        explicit = []
        for spectrum in batches:
            values = pad(spectrum.eigenvalues, (0, rank - spectrum.eigenvalues.shape[1]))
            missing = weighted and spectrum.weights is None
            weights = torch.ones_like(spectrum.scaling) if missing else spectrum.weights
            explicit.append(replace(spectrum, eigenvalues=values, weights=weights))
        return explicit

    @property
    def pixels(self) -> float | Tensor:
        """Number of pixels N of the whole image; for weighted points the sums of the weights, (B,)."""
        if self.weights is not None:
            return self.communicator.sum(self.weights.sum(1))
        return self.communicator.pixels(self.scaling.shape[1])

    @property
    def mass(self) -> Tensor:
        """Coefficients (B, N) of sums over points, the scaling d times the weights of the points."""
        return weighted(self.scaling, self.weights)

    @property
    def eigenvectors(self) -> Tensor:
        """(B, R, ...), orthonormal over the pixels, in the order of the eigenvalues; zero for padded eigenvalues.

        The first is constant and positive as far as the landmarks span the constant vector (exactly so for W; without
        completion to the tolerance of the balancing), also if the eigenvalue 1 is repeated. Differentiable, but with
        the limits of :func:`torch.linalg.eigh`: the gradient is NaN if eigenvalues are equal. Results that do not
        depend on the choice of eigenvectors (:func:`spectral_filter`, masks) always have an exact gradient.
        """
        return self._recorded if torch.is_grad_enabled() and self.ritz.matrix.requires_grad else self._constant

    @cached_property
    @full_precision
    def _recorded(self) -> Tensor:
        return self._form(torch.linalg.eigh(self.ritz.matrix).eigenvectors.flip(-1))

    @cached_property
    @torch.inference_mode(False)
    @torch.no_grad()
    @full_precision
    def _constant(self) -> Tensor:
        """Cached separately, so that a call without gradients does not replace eigenvectors that have a gradient."""
        return self._form(self.ritz.vectors)

    def _form(self, vectors: Tensor) -> Tensor:
        """Form the eigenvectors (B, R, ...) from those of T, (B, M, M)."""
        basis = self._rows(vectors) @ self.factor  # (B, R, N)
        return (basis * self.scaling.unsqueeze(1)).unflatten(2, self.size)

    def _rows(self, vectors: Tensor) -> Tensor:
        """Rows (B, R, M) whose product with the scaled factor is the eigenvectors, from those of T, (B, M, M)."""
        vectors = (vectors * self.support.unsqueeze(1))[:, :, : self.eigenvalues.shape[1]]
        return (self.root @ self._constant_first(vectors)).mT.to(self.factor)

    @torch.no_grad()
    @full_precision
    def some_eigenvectors(self, numbers: Sequence[int]) -> Tensor:
        """Form the K eigenvectors with these numbers, counted from 0, (B, K, ...), without a gradient.

        Raises:
            ValueError: if there is no eigenvector of a number.

        Example:
            >>> from nlfilter_torch import nonlocal_operator
            >>> spectrum = nonlocal_operator(torch.rand(1, 1, 24, 32), num_landmarks=20).spectrum()
            >>> torch.allclose(spectrum.some_eigenvectors([0, 7]), spectrum.eigenvectors[:, [0, 7]], atol=1e-6)
            True
        """
        rank = self.eigenvalues.shape[1]
        if not all(0 <= number < rank for number in numbers):
            raise ValueError(f"numbers must be from 0 to {rank - 1}, got {list(numbers)}; leave out the others")
        basis = self._rows(self.ritz.vectors)[:, list(numbers)] @ self.factor
        return (basis * self.scaling.unsqueeze(1)).unflatten(2, self.size)

    @full_precision
    def eigenvectors_at(self, columns: Columns) -> Tensor:
        """Extend the eigenvectors to points that the operator was not made from, (B, R, n).

        The eigenvectors are functions of the features of a point, and this evaluates them; at the operator's own points
        they are :attr:`eigenvectors`. Times ``sqrt(N) eigenvalues^t`` they are the coordinates of
        :func:`diffusion_map`.

        Args:
            columns: of the points, by :meth:`NonlocalOperator.at`.

        Returns:
            (B, R, n). Differentiable, with the limits of :attr:`eigenvectors`.

        Raises:
            TypeError, ValueError: if ``columns`` are not those of an operator with as many landmarks.

        Example:
            >>> from nlfilter_torch import operator_from_features
            >>> points = torch.rand(1, 2, 300, generator=torch.Generator().manual_seed(0))
            >>> operator = operator_from_features(points / 0.3, size=(300,), num_landmarks=20)
            >>> spectrum = operator.spectrum(rank=4)
            >>> again = spectrum.eigenvectors_at(operator.at(points[..., :10] / 0.3))
            >>> torch.allclose(again, spectrum.eigenvectors[:, :, 0, :10], atol=1e-4)
            True
        """
        check_instance(columns, Columns, "columns", "take operator.at(features)")
        if columns.factor.shape[1] != self.factor.shape[1]:
            raise ValueError(
                f"columns must be of an operator with {self.factor.shape[1]} landmarks, got "
                f"{columns.factor.shape[1]}; take them from the operator of the spectrum"
            )
        recorded = torch.is_grad_enabled() and self.ritz.matrix.requires_grad
        vectors = torch.linalg.eigh(self.ritz.matrix).eigenvectors.flip(-1) if recorded else self.ritz.vectors
        return spread(self._rows(vectors), columns.factor, columns.scaling)

    @full_precision
    def coefficients(self, image: Tensor) -> Tensor:
        """Compute ``F y``, which determines ``f(W) y`` for every response f, in one read of the factor.

        To apply several responses to one image, or to learn one, compute ``F y`` once; see :func:`spectral_filter`.

        Args:
            image: y, (B, C, ...) or (B, C, N).

        Returns:
            (B, C, M) in float64. Differentiable in image and operator.

        Raises:
            TypeError, ValueError: if ``image`` is not a finite floating-point tensor of the spectrum's size.
        """
        check_fits(image, self.size, "image", "spectrum", self.factor)
        planes = fold_batch(trainable(image).to(self.factor), self.factor.shape[0])
        total = self.communicator.sum(moment(self.factor, self.mass.unsqueeze(1) * planes))  # (B, M, C)
        return unfold_batch(total.mT.unsqueeze(1), image.shape[0], (total.shape[1], 1))[:, 0, :, :, 0]

    @full_precision
    def synthesize(self, response: Response, coefficients: Tensor) -> Tensor:
        """Compute ``V f(S) V^T y``, (B, C, ...), from a response f and coefficients (B, C, M) of y."""
        return self.synthesize_each((response,), coefficients)[0]

    def synthesize_each(self, responses: Sequence[Response], coefficients: Tensor) -> tuple[Tensor, ...]:
        """:meth:`synthesize` for several responses, in one read of the factor."""
        check_coefficients(coefficients, self.factor)
        count = coefficients.shape[0]
        total = fold_batch(coefficients.unsqueeze(3), self.factor.shape[0])  # (B, C, M)
        filtered = torch.cat([total @ self.gain(response).mT for response in responses], dim=1)
        planes = spread(filtered.to(self.factor), self.factor, self.scaling)
        parts = planes.chunk(len(responses), dim=1)
        return tuple(unfold_batch(part.unsqueeze(1), count, self.size)[:, 0] for part in parts)

    def _constant_first(self, vectors: Tensor) -> Tensor:
        """Reflect the eigenvectors (B, M, R) of the eigenvalue 1 so that the first of them is the constant image."""
        with torch.no_grad():
            ones = self.communicator.sum(moment(self.factor, self.mass.unsqueeze(1)))  # F 1, (B, M, 1)
            # The residual is larger if the operator was balanced in float32 and converted to float64.
            distance = (10 * self.residual).clamp(CLUSTER[self.factor.dtype], CLUSTER[torch.float32])
            cluster = self.eigenvalues > 1 - distance.unsqueeze(1)
            cluster[:, :1] = True
            target = (vectors.mT @ self.root @ ones).squeeze(2) * cluster  # (B, R)
            mirror = target / target.norm(dim=1, keepdim=True).clamp(min=1e-12)
            mirror[:, :1] -= 1.0
            length = mirror.square().sum(1, keepdim=True).unsqueeze(2)
            # A reflection preserves lengths however short the mirror is; the clamp only avoids 0 / 0.
            reflection = (
                2 * mirror.unsqueeze(2) * mirror.unsqueeze(1) / length.clamp(min=torch.finfo(length.dtype).tiny)
            )
        return vectors - vectors @ reflection


loadable(Spectrum, SymmetricMatrix, Communicator)


def compute_spectrum(
    matrix: PixelMatrix, size: tuple[int, ...], rank: int | None, residual: Tensor, *, completed: bool
) -> Spectrum:
    """Compute the spectrum of ``W``, whose kernel has a diagonal part r only if it was ``completed``."""
    factor, communicator, remainder = matrix.factor, matrix.communicator, matrix.remainder if completed else None
    # F F^T and F diag(r) F^T, (B, J, M, M)
    count = 1 if remainder is None else 2
    root_scaling = root_weighted(matrix.scaling, matrix.weights)
    pairs = RitzPairs.of_sums(communicator.sum(compute_grams(factor, root_scaling, remainder, count)), factor.dtype)
    seen = factor.shape[0] > 0 and not is_hidden(factor)
    checked = factor.dtype == torch.float32 and seen
    if checked and float(pairs.root.detach().square().sum((1, 2)).max()) > WEAK:
        grams = compute_grams(factor, root_scaling, remainder, count, exact=True)
        pairs = RitzPairs.of_sums(communicator.sum(grams), factor.dtype)
    shown = int(pairs.support.sum(1).max()) if seen else factor.shape[1]
    shown = shown if rank is None else min(rank, shown)
    support = pairs.support & (torch.arange(factor.shape[1], device=factor.device) < shown)
    # First-order perturbation: the derivative of an eigenvalue is v^T dT v, also for repeated ones.
    vectors = pairs.ritz.vectors
    values = (vectors * (pairs.ritz.matrix @ vectors)).sum(1)
    eigenvalues = (values.clamp(0.0, 1.0) * support)[:, :shown].to(factor)
    return Spectrum(
        pairs.ritz,
        pairs.root,
        support,
        eigenvalues,
        factor,
        matrix.scaling,
        size,
        largest=values[:, 0].detach(),
        residual=residual,
        weights=matrix.weights,
        communicator=communicator,
        remainder=remainder,
    )
