"""The filter W as an object, with its products, spectrum and diagnostics. Paper: Sec. II."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import fold_batch, unfold_batch, weighted
from nlfilter_torch.core.checks import (
    check_count,
    check_features,
    check_fits,
    check_instance,
    check_order,
    spelled,
)
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.containers import Batch, loadable
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.precision import full_precision, trainable, uncompiled
from nlfilter_torch.core.torch_internals import in_format_of, outside_transforms, refuse_transforms
from nlfilter_torch.operator.eigenvalue_bound import largest_eigenvalue
from nlfilter_torch.operator.features import GuideFeatures
from nlfilter_torch.operator.nystrom import nystrom_factor
from nlfilter_torch.operator.options import Assignment, Completion
from nlfilter_torch.operator.pixel_matrix import Columns, PixelMatrix
from nlfilter_torch.operator.scaling import KernelMatrix, PixelScaling
from nlfilter_torch.operator.spectrum import Spectrum, compute_spectrum
from nlfilter_torch.operator.traps import SAMPLED, SampledRows, sampled_points

DENSE_LIMIT = 1 << 14  # pixels; the dense matrix of a 128x128 image takes 1 GB in float32


@dataclass(frozen=True, eq=False)
class Kernel:
    """Affinities to a fixed set of landmarks.

    Attributes:
        landmarks: (B, D, M).
        inverse_cholesky: (B, M, M).
        completion: ``"diagonal"`` or ``"none"``.
        limiter: (B, M, M) matrix by which the factor is multiplied so that no eigenvalue of W exceeds 1, or None.
        features: computes features of a guide; None if the operator was made from features.
        assignment: of which points the landmarks are made; None if they were passed as features.
        sample: features (B, D, S) of the :func:`sampled_points` of the operator's own points; None in compiled
            programs, and if rows are distributed. Without a gradient.
    """

    landmarks: Tensor
    inverse_cholesky: Tensor
    completion: Completion
    limiter: Tensor | None = None
    features: GuideFeatures | None = None
    assignment: Assignment | None = None
    sample: Tensor | None = None

    @property
    def recipe(self) -> GuideFeatures:
        """The function that computes features of a guide.

        Raises:
            ValueError: if the operator was made from features.
        """
        if self.features is None:
            raise ValueError(
                "operator must be built by nonlocal_operator to be applied to other guides, got one from features; "
                "use operator.at(features)"
            )
        return self.features

    def columns(
        self, guide: Tensor, *, origin: tuple[int, ...] = (0, 0), halo: tuple[int, int] = (0, 0)
    ) -> tuple[Tensor, Tensor]:
        """Compute factor (B, M, N) and diagonal (B, N) of the pixels of any guide; see :class:`GuideFeatures`."""
        return self.factor(self.recipe(guide, origin=origin, halo=halo))

    def factor(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Compute factor (B, M, n) and diagonal (B, n) of pixels with features (B, D, n).

        Landmarks with a batch size of 1 serve for all images.
        """
        shape = (features.shape[0], -1, -1)
        landmarks, inverse = self.landmarks.expand(shape), self.inverse_cholesky.expand(shape)
        factor, diagonal = nystrom_factor(features, landmarks, inverse, self.completion)
        return factor if self.limiter is None else self.limiter @ factor, diagonal


@dataclass(frozen=True)
class Diagnostics:
    """Measures of the quality of an operator; lists have one entry per image.

    Attributes:
        pixels: N; for weighted points the sum of the weights, averaged over the images.
        num_landmarks: M.
        rank: number of eigenvectors above rounding.
        photometric_bandwidth: h_y in units of the guide; 1 for an operator made from features.
        balancing_steps: number of sweeps over the factor in balancing.
        row_sum_residual: largest deviation of a row sum from 1.
        smallest_row_sum: smallest row sum of the kernel before balancing; without completion, W fails if it nears zero.
        largest_eigenvalue: upper bound of the eigenvalues; see :class:`Certificate`.
        eigenvector_residual: largest ||W v - lambda v|| over the unit eigenvectors.
        orthogonality: largest deviation of V V^T from the identity.
        diagonal_share: mean of the diagonal part r of W, the weight with which a pixel keeps its own value.
        badly_covered: share of the pixels that the landmarks cover badly; see :meth:`NonlocalOperator.badly_covered`.
    """

    pixels: int
    num_landmarks: int
    rank: list[int]
    photometric_bandwidth: list[float]
    balancing_steps: int
    row_sum_residual: list[float]
    smallest_row_sum: list[float]
    largest_eigenvalue: list[float]
    eigenvector_residual: list[float]
    orthogonality: list[float]
    diagonal_share: list[float]
    badly_covered: list[float]


@dataclass(frozen=True)
class Certificate:
    """Measured properties of an operator; lists have one entry per image.

    Attributes:
        symmetry: difference of ``x^T W y`` and ``y^T W x`` for random images x and y, relative to their norms.
        row_sums: largest deviation of a row sum from 1.
        smallest_eigenvalue: lower bound of the eigenvalues: the smallest r, as the rest of W is positive semi-definite.
        largest_eigenvalue: upper bound of the eigenvalues; exactly 1 if none exceeds 1 by more than rounding.
    """

    symmetry: list[float]
    row_sums: list[float]
    smallest_eigenvalue: list[float]
    largest_eigenvalue: list[float]


@dataclass(frozen=True, eq=False, repr=False)
class NonlocalOperator(Batch):
    """The symmetric, doubly stochastic filter ``W = diag(d) U^T U diag(d) + diag(r)`` of an image, never formed.

    Made by :func:`nonlocal_operator`. Every pixel is linked to every other through M landmarks; W has unit row sums and
    its eigenvalues lie in [0, 1]. With few landmarks, approximate affinities may be negative. A pixel whose affinities
    to all others sum to less than zero keeps its value; eigenvalues that would exceed 1 are set to 1.

    Operators are values: ``operator[0]``, ``operator[1:3]`` and iteration select images, :meth:`cat` joins operators,
    and :meth:`to` and :meth:`detach` return new ones. :func:`collate` joins those of a data set.

    Attributes:
        factor: U, (B, M, N), pixels last.
        diagonal: c, (B, N), the correction that makes the diagonal of the kernel 1; zeros without completion.
        scaling: d, (B, N), positive.
        size: (H, W) of images, (D, H, W) of volumes, or that of :func:`operator_from_features`.
        kernel: computes factor and diagonal of the pixels of other guides.
        remainder: r, (B, N), the diagonal part of W.
        weights: number of pixels that each point represents, (B, N); None means one each. With weights, ``W y`` is
            ``diag(d) U^T U diag(weights d) y + r y``, which sums over the pixels that the points represent. A point of
            weight 0 is filtered from those that count, and keeps its value only if it resembles none of them.
        balancing: computes the scaling of other pixels.
        residual: largest deviation of a row sum of W from 1, (B,).
        balancing_steps: number of sweeps over the factor in balancing.
        communicator: ranks that the rows of the image are distributed over; all attributes are then those of this
            rank's rows.
    """

    factor: Tensor
    diagonal: Tensor
    scaling: Tensor
    size: tuple[int, ...]
    kernel: Kernel
    remainder: Tensor
    balancing: PixelScaling
    residual: Tensor
    balancing_steps: int
    weights: Tensor | None = None
    communicator: Communicator = ALONE

    def __repr__(self) -> str:
        images = len(self)
        return (
            f"NonlocalOperator({images} image{'' if images == 1 else 's'} of {spelled(self.size)}, "
            f"{self.factor.shape[1]} landmarks, {self.dtype}, {self.device})"
        )

    @property
    def landmarks(self) -> Tensor:
        """Features of the landmarks (B, D, M), which ``landmarks=`` of another operator takes; differentiable.

        They are divided by the bandwidths of this operator, like the features of :func:`operator_from_features`.
        """
        return self.kernel.landmarks

    @property
    def assignment(self) -> Assignment | None:
        """Of which pixels the landmarks are made; None if they were passed as features."""
        return self.kernel.assignment

    @property
    def matrix(self) -> PixelMatrix:
        """W for points in a row, whose products are with planes (B, C, N)."""
        return PixelMatrix(self.factor, self.scaling, self.remainder, self.weights, self.communicator)

    @property
    def shape(self) -> torch.Size:
        """Shape (B, N, N) of the matrices W; :attr:`size` is that of the images."""
        images, _, pixels = self.factor.shape
        return torch.Size((images, pixels, pixels))

    @classmethod
    def alike(cls, batches: Sequence[Self]) -> Sequence[Self]:
        """The operators, with weights and a limiter if one of them has these, and equally many rounds of balancing.

        Without an assignment if theirs cannot be joined, so that the landmarks are kept as features, and without a
        sample of features if one of them has none.
        """
        weighted = any(operator.weights is not None for operator in batches)
        limited = any(operator.kernel.limiter is not None for operator in batches)
        rounds = max(len(operator.balancing.before) for operator in batches)
        assigned = len({operator.assignment and operator.assignment.kind for operator in batches}) == 1
        if any(operator.kernel.sample is None for operator in batches):
            batches = [replace(operator, kernel=replace(operator.kernel, sample=None)) for operator in batches]
        return [operator._explicit(weighted, limited, rounds, assigned) for operator in batches]

    def _explicit(self, weighted: bool, limited: bool, rounds: int, assigned: bool) -> Self:
        """The same operator, with fields of neutral values where they are missing."""
        kernel, balancing, weights = self.kernel, self.balancing, self.weights
        if not assigned:
            kernel = replace(kernel, assignment=None)
        if limited and kernel.limiter is None:
            identity = torch.eye(self.factor.shape[1], dtype=self.dtype, device=self.device)
            kernel = replace(kernel, limiter=identity.expand(len(self), -1, -1))
        if weighted and weights is None:
            weights = torch.ones_like(self.scaling)
            balancing = replace(balancing, least=torch.ones_like(self.scaling[:, :1]))
        before = (*balancing.before, *[balancing.moment] * (rounds - len(balancing.before)))
        return replace(self, kernel=kernel, weights=weights, balancing=replace(balancing, before=before))

    @outside_transforms
    @full_precision
    def at(self, features: Tensor) -> Columns:
        """Compute the columns of any points from their own features and from sums over the image.

        Differentiable once in both features, those of the points and those of the operator.

        Args:
            features: (B, D, n), of points of this image or another, with the meaning and scale of the features that the
                operator was made from. A batch of 1, of points or of the operator, serves for all of the other.

        Raises:
            TypeError, ValueError: if ``features`` is not a finite floating-point tensor with the operator's D, or its
                batch size does not fit.
        """
        refuse_transforms(features=features, operator=self.factor)
        check_features(features, "features", self.kernel.landmarks.shape[1])
        images, batch = len(self.factor), len(features)
        if 1 not in (images, batch) and images != batch:
            raise ValueError(
                f"features must have batch size 1 or {images}, like the operator, got {batch}; pass one set of points "
                "for each image"
            )
        features = features if batch > 1 else features.expand(images, -1, -1)
        factor, diagonal = self.kernel.factor(features.to(self.kernel.landmarks))
        return Columns(factor, *self.differentiable_balancing()(factor, diagonal))

    @full_precision
    def nystrom_blocks(self) -> tuple[Tensor, Tensor]:
        """Form the blocks W_A and W_AB of W, from which the paper computes its eigenvectors. Paper: Fig. 2.

        A is the landmarks, whether they are pixels of the image or the centroids of clusters, with the scaling and the
        diagonal part that pixels with their features would have. B is all pixels, in the order of ``image.flatten(2)``;
        landmarks that are pixels are in both, and the diagonal part of W is in W_A alone. Entries are weights between
        two single pixels, also if points represent several (``weights``).

        Returns:
            W_A, (B, M, M), and W_AB, (B, M, N). Without their diagonals r, ``W = W_AB^T (W_A - diag(r))^-1 W_AB``.
            Differentiable in the operator.

        Example:
            >>> from nlfilter_torch import nonlocal_operator
            >>> guide = torch.rand(1, 1, 12, 12, generator=torch.Generator().manual_seed(0))
            >>> operator = nonlocal_operator(guide, num_landmarks=9, landmarks="uniform")
            >>> within, across = operator.nystrom_blocks()
            >>> within.shape, across.shape
            (torch.Size([1, 9, 9]), torch.Size([1, 9, 144]))
            >>> middle = 6 * 12 + 6  # the middle one of the landmarks, a grid of 3x3 pixels, is this pixel
            >>> torch.allclose(within[0, 4, 4], operator.to_dense()[0, middle, middle])
            True
        """
        landmarks = self.at(self.landmarks)
        scaled = landmarks.factor * landmarks.scaling.unsqueeze(1)  # (B, M, M)
        within = scaled.mT @ scaled + torch.diag_embed(landmarks.remainder)
        return within, spread(scaled.mT, self.factor, self.scaling)

    @full_precision
    def differentiable_balancing(self) -> PixelScaling:
        """:attr:`balancing`, whose moment has no gradient, with one that has, recomputed from the factor."""
        if not self.factor.requires_grad:
            return self.balancing
        scaling = weighted(self.scaling, self.weights).unsqueeze(1)
        return replace(self.balancing, moment=self.communicator.sum(moment(self.factor, scaling)))

    def matmul(self, image: Tensor) -> Tensor:
        """Compute ``W y``, also written ``operator @ image``. Paper: eq. (2).

        Args:
            image: (B, C, H, W) of the guide's height and width, (B, C, D, H, W) for a volume, or (B, C, N) with the
                same points in a row; any number of channels, any floating-point dtype. A batch of 1 on either side is
                broadcast.

        Returns:
            (B, C, H, W), or the image's other dimensions, in its dtype, with the same mean as the image. Differentiable
            in image and operator.

        Raises:
            TypeError, ValueError: if ``image`` is not a finite floating-point tensor of that size.
        """
        return in_format_of(self.powers(image, 1)[:, 0], image)

    def __matmul__(self, image: Tensor) -> Tensor:
        return self.matmul(image)

    @full_precision
    def powers(self, image: Tensor, order: int) -> Tensor:
        """Compute ``W y, ..., W^k y``, (B, k, C, ...), in the operator's dtype; arguments and errors as in matmul."""
        check_order(order)
        check_fits(image, self.size, "image", "operator", self.factor, empty=True)
        folded = fold_batch(trainable(image).to(self.factor), self.factor.shape[0])
        if folded.numel() == 0:  # an empty batch
            return image[:0].to(self.factor).unsqueeze(1).expand(-1, order, *image.shape[1:])
        return unfold_batch(self.matrix.powers(folded, order), image.shape[0], image.shape[2:])

    @property
    def diagonal_share(self) -> Tensor:
        """The weight r in [0, 1] with which a pixel keeps its own value where few pixels are similar, (B, 1, ...)."""
        return self.remainder.unflatten(1, self.size).unsqueeze(1)

    def row_sums(self) -> Tensor:
        """Row sums of W, (B, 1, ...): one everywhere, with an error of about :attr:`residual`."""
        batch = self.factor.shape[0]
        return self.matmul(self.factor.new_ones(batch, 1, *self.size))

    @full_precision
    def to_dense(self) -> Tensor:
        """Form the whole matrix W, (B, N, N), symmetric unless the points have weights. For small images.

        Raises:
            ValueError: if the image has more than 16384 pixels, or this rank holds only some of its rows.
        """
        self.communicator.check_whole("to_dense")
        pixels = self.factor.shape[2]
        if pixels > DENSE_LIMIT:
            raise ValueError(
                f"the operator must have at most {DENSE_LIMIT} pixels for a dense matrix, got {pixels}; "
                "use a smaller image"
            )
        scaled = self.factor * self.scaling.unsqueeze(1)  # scaled first: without completion U^T U may underflow
        return weighted(scaled.mT @ scaled, self.weights) + torch.diag_embed(self.remainder)

    @uncompiled
    @outside_transforms
    @full_precision
    def spectrum(self, rank: int | None = None) -> Spectrum:
        """Compute the leading eigenvalues and eigenvectors. Paper: eq. (3), (4).

        Args:
            rank: maximum number of them; None keeps all that are above rounding, at most M.

        Raises:
            TypeError, ValueError: if ``rank`` is not a positive integer.
        """
        if rank is not None:
            check_count(rank, "rank")
        completed = self.kernel.completion == "diagonal"
        return compute_spectrum(self.matrix, self.size, rank, self.residual, completed=completed)

    @full_precision
    @torch.no_grad()
    def certify(self) -> "Certificate":
        """Measure symmetry, row sums and eigenvalue bounds of W, at the cost of a Gram matrix and three products.

        Example:
            >>> from nlfilter_torch import nonlocal_operator
            >>> guide = torch.rand(1, 1, 32, 48, generator=torch.Generator().manual_seed(0))
            >>> certificate = nonlocal_operator(guide, num_landmarks=20).certify()
            >>> certificate.row_sums[0] < 1e-4 and certificate.symmetry[0] < 1e-6
            True
            >>> 0 <= certificate.smallest_eigenvalue[0] and certificate.largest_eigenvalue[0] < 1.0001
            True
        """
        batch, generator = self.factor.shape[0], torch.Generator().manual_seed(0)
        images = torch.randn(1, 2, *self.size, generator=generator, dtype=torch.float64).to(self.factor)
        x, y = images.expand(batch, *images.shape[1:]).split(1, dim=1)
        products = torch.cat([x * (self @ y), y * (self @ x)], dim=1).double().flatten(2)
        products = weighted(products, self.weights).sum(2)
        inner = self.communicator.sum(products)
        lengths = self.communicator.sum(images[0].double().square().flatten(1).sum(1))
        highest, lowest = (self.communicator.max((sign * self.remainder).amax(1)) for sign in (1, -1))
        return Certificate(
            symmetry=((inner[:, 0] - inner[:, 1]).abs() / lengths.prod().sqrt()).tolist(),
            row_sums=self.communicator.max((self.row_sums() - 1).abs().flatten(1).amax(1)).tolist(),
            smallest_eigenvalue=(-lowest).tolist(),
            largest_eigenvalue=largest_eigenvalue(self.matrix.gram_below, highest, self.factor.dtype).tolist(),
        )

    @full_precision
    @torch.no_grad()
    def badly_covered(self, sampled: int = SAMPLED) -> Tensor:
        """Estimate the share of the points that the landmarks cover badly, by their weights: (B,), from 0 to 1.

        A point counts as badly covered if more than half of the weight of its row of W lies at other points than in the
        exact filter, in which every two points are compared: no landmark resembles those that resemble it. Other
        landmarks, more of them, or a larger bandwidth lower the share. Points that resemble no other are not badly
        covered: they keep their values in the exact filter, too.

        Both filters are those of a sample of at most ``sampled`` points, so that the cost does not depend on the size
        of the image: about 0.05 s on one core for 1024 points. Of similarities that are rarer than one in so many
        points, none may be seen; with few points, shares of a few percent are noise. If there are at most 2048 points
        in all, the sample is all of them, and the share is exact.

        Args:
            sampled: number of points, of the 1024 whose features are kept.

        Returns:
            (B,) in float64; NaN for an operator built by a compiled program or over ranks, which keeps no features.

        Raises:
            TypeError, ValueError: if ``sampled`` is not a positive integer.

        Example:
            >>> from nlfilter_torch import operator_from_features
            >>> generator = torch.Generator().manual_seed(0)
            >>> centres = torch.randn(20, 8, generator=generator)
            >>> points = (centres.repeat(50, 1) + 0.1 * torch.randn(1000, 8, generator=generator)).mT[None]
            >>> few, many = (operator_from_features(points, size=(1000,), num_landmarks=m) for m in (10, 30))
            >>> round(float(few.badly_covered()), 1), round(float(many.badly_covered()), 1)
            (0.7, 0.0)
        """
        check_count(sampled, "sampled")
        if self.kernel.sample is None:
            return self.factor.new_full((len(self),), torch.nan, dtype=torch.float64)
        points = self.communicator.pixels(self.factor.shape[2])
        places = sampled_points(points).to(self.device)
        weights = torch.ones_like(self.scaling) if self.weights is None else self.weights.expand_as(self.scaling)
        planes = torch.stack([self.scaling, self.remainder, weights.to(self.scaling)], dim=1)
        factor, planes = (self.communicator.columns(tensor, places) for tensor in (self.factor, planes))
        scaling, remainder, weights = planes.unbind(1)
        rows = SampledRows(self.kernel.sample, factor, scaling, remainder, weights, points / len(places))
        return rows.thinned(sampled).badly_covered()

    @full_precision
    @torch.no_grad()
    def diagnostics(self, eigenvectors: int | None = None, spectrum: Spectrum | None = None) -> Diagnostics:
        """Measure the quality of the operator, at several times the cost of the spectrum.

        Args:
            eigenvectors: how many of them are formed and measured, evenly spread over the spectrum; fewer take less
                time. None is all.
            spectrum: :meth:`spectrum` of this operator, if it has been computed.

        Raises:
            TypeError, ValueError: if ``eigenvectors`` is not a positive integer, or ``spectrum`` is none.
        """
        spectrum, certificate = self.spectrum() if spectrum is None else spectrum, self.certify()
        check_instance(spectrum, Spectrum, "spectrum", "take operator.spectrum()")
        rank = spectrum.eigenvalues.shape[1]
        if eigenvectors is None:
            numbers, vectors = list(range(rank)), spectrum.eigenvectors.flatten(2)  # (B, K, N)
        else:
            check_count(eigenvectors, "eigenvectors")
            numbers = torch.linspace(0, rank - 1, min(eigenvectors, rank)).round().long().tolist()
            vectors = spectrum.some_eigenvectors(numbers).flatten(2)
        values, errors = spectrum.eigenvalues[:, numbers], list[Tensor]()
        for part, eigenvalues in zip(vectors.split(16, dim=1), values.split(16, dim=1), strict=True):
            error = (self.matmul(part) - eigenvalues.unsqueeze(2) * part).square()
            errors.append(weighted(error, self.weights).sum(2))
        residual = self.communicator.sum(torch.cat(errors, dim=1)).sqrt()
        inner = self.communicator.sum(weighted(vectors, self.weights) @ vectors.mT)
        occupied = torch.diag_embed(spectrum.support[:, numbers].to(vectors))
        matrix = KernelMatrix(self.factor, self.diagonal, self.weights, self.communicator)
        kernel_sums = matrix.affinities(matrix.moment(torch.ones_like(self.scaling))) + self.diagonal
        if self.weights is not None:
            kernel_sums = torch.where(self.weights > 0, kernel_sums, torch.inf)  # rows that count
        recipe = self.kernel.features
        pixels = torch.as_tensor(spectrum.pixels).to(self.factor)
        bandwidth = torch.as_tensor(1.0 if recipe is None else recipe.photometric_bandwidth).reshape(-1)
        return Diagnostics(
            pixels=round(float(pixels.mean())),
            num_landmarks=self.factor.shape[1],
            rank=spectrum.support.sum(1).tolist(),
            photometric_bandwidth=bandwidth.expand(self.factor.shape[0]).tolist(),
            balancing_steps=self.balancing_steps,
            row_sum_residual=certificate.row_sums,
            smallest_row_sum=(-self.communicator.max(-kernel_sums.amin(1))).tolist(),
            largest_eigenvalue=certificate.largest_eigenvalue,
            eigenvector_residual=residual.amax(1).tolist(),
            orthogonality=(inner - occupied).abs().amax((1, 2)).tolist(),
            diagonal_share=(self.communicator.sum(weighted(self.remainder, self.weights).sum(1)) / pixels).tolist(),
            badly_covered=self.badly_covered().tolist(),
        )


loadable(NonlocalOperator, Kernel, Assignment, GuideFeatures, PixelScaling, Communicator, Columns)
