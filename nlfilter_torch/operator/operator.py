"""Guide to operator: the filter W as an object. Paper: Sec. II."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import fold_batch, unfold_batch
from nlfilter_torch.core.checks import (
    called_by_edit,
    check_choice,
    check_count,
    check_image,
    check_instance,
    check_number,
    check_order,
    check_positive,
    check_same_size,
    check_scale,
    described,
    is_hidden,
    warn,
    warn_of_scale,
)
from nlfilter_torch.core.communicator import Shard, check_whole, meet, reduce_max, reduce_sum, replicate, with_halo
from nlfilter_torch.core.compilation import uncompiled
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.operator.balancing import balance, warn_of_residual
from nlfilter_torch.operator.eigenvalue_bound import exceeds, is_bounded, largest_eigenvalue, limiter, shifted_gram
from nlfilter_torch.operator.features import (
    GuideChannels,
    bandwidth_of_rows,
    extract_features,
    reduce_channels,
    unit_window,
)
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.landmarks import Sampling, choose_landmarks
from nlfilter_torch.operator.newton import PixelScaling, isolated, row_sums
from nlfilter_torch.operator.nystrom import Completion, whitener
from nlfilter_torch.operator.products import apply_powers
from nlfilter_torch.operator.spectrum import Spectrum, compute_spectrum

ROUNDS = 8  # in which isolated pixels are taken out; one or two are the rule
DENSE_LIMIT = 1 << 14  # pixels; the dense matrix of a 128x128 image takes 1 GB in float32


@dataclass(frozen=True)
class Diagnostics:
    """Figures that tell how good an operator is; those of shape (B,) are lists with one entry per image.

    Attributes:
        pixels: N.
        num_landmarks: M.
        rank: eigenvectors that rise above rounding.
        photometric_bandwidth: h_y in units of the guide.
        balancing_steps: sweeps over the factor that balancing took.
        row_sum_residual: largest deviation of a row sum from 1.
        smallest_row_sum: the least row sum of the kernel before balancing; the plain method fails as it nears zero.
        largest_eigenvalue: an upper bound, as :meth:`NonlocalOperator.certify` has it.
        eigenvector_residual: largest ||W v - lambda v|| over the unit eigenvectors.
        orthogonality: largest deviation of V V^T from the identity.
        diagonal_share: mean of the diagonal part r of W: how much of a pixel the landmarks leave to itself.
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


@dataclass(frozen=True)
class Certificate:
    """What an operator keeps of its promises, measured; lists with one entry per image.

    Attributes:
        symmetry: difference of ``x^T W y`` and ``y^T W x`` for random images x and y, relative to their lengths.
        row_sums: largest deviation of a row sum from 1.
        smallest_eigenvalue: a lower bound of the eigenvalues: the smallest r, since the rest of W is positive
            semi-definite.
        largest_eigenvalue: an upper bound of the eigenvalues; exactly 1 where none exceeds 1 but for rounding.
    """

    symmetry: list[float]
    row_sums: list[float]
    smallest_eigenvalue: list[float]
    largest_eigenvalue: list[float]


@dataclass(frozen=True, eq=False)
class NonlocalOperator:
    """The symmetric, doubly stochastic filter ``W = diag(d) U^T U diag(d) + diag(r)`` of an image, never formed.

    Made by :func:`nonlocal_operator`. Every pixel is linked to every other one through M landmarks; W has unit row sums
    and its eigenvalues lie in [0, 1]. Affinities that pass through few landmarks may be negative. A pixel whose
    affinities to all others sum to less than zero keeps its value; eigenvalues that would exceed 1 are set to 1.

    Attributes:
        factor: U, (B, M, N), pixels last.
        diagonal: c, (B, N), what the landmarks miss of the kernel's unit diagonal; zeros without completion.
        scaling: d, (B, N), positive.
        size: (H, W).
        kernel: the recipe of factor and diagonal, for the pixels of other guides.
        remainder: r, (B, N), the diagonal part of W.
        balancing: what the scaling of other pixels is a function of.
        residual: largest deviation of a row sum of W from 1, (B,).
        balancing_steps: sweeps over the factor that balancing took.
        shard: of the image, where other ranks have the rest of it; everything above is then what is here.
    """

    factor: Tensor
    diagonal: Tensor
    scaling: Tensor
    size: tuple[int, int]
    kernel: Kernel
    remainder: Tensor
    balancing: PixelScaling
    residual: Tensor
    balancing_steps: int
    shard: Shard | None = None

    def matmul(self, image: Tensor) -> Tensor:
        """``W y``, also written ``operator @ image``. Paper: eq. (2).

        Args:
            image: (B, C, H, W) of the guide's height and width, any number of channels, any floating-point dtype. A
                batch of 1 on either side is broadcast.

        Returns:
            (B, C, H, W) in the image's dtype, with the mean of the image. Differentiable in image and operator.

        Raises:
            TypeError, ValueError: if ``image`` is not a finite floating-point tensor of that size.
        """
        return self.powers(image, 1)[:, 0].to(image.dtype)

    def __matmul__(self, image: Tensor) -> Tensor:
        return self.matmul(image)

    @full_precision
    def powers(self, image: Tensor, order: int) -> Tensor:
        """``W y, ..., W^k y`` as (B, k, C, H, W) in the operator's dtype; arguments and errors as :meth:`matmul`."""
        check_order(order)
        check_image(image, "image")
        check_same_size(image, self.size, "image", "operator")
        folded = fold_batch(image.to(self.factor), self.factor.shape[0])
        planes = apply_powers(self.factor, self.scaling, self.remainder, folded, order, self.shard)
        return unfold_batch(planes, image.shape[0], self.size)

    @property
    def diagonal_share(self) -> Tensor:
        """What W takes of a pixel's own value for want of pixels like it, r in [0, 1] as (B, 1, H, W)."""
        return self.remainder.unflatten(1, self.size).unsqueeze(1)

    def row_sums(self) -> Tensor:
        """(B, 1, H, W), one everywhere to :attr:`residual`."""
        batch = self.factor.shape[0]
        return self.matmul(self.factor.new_ones(batch, 1, *self.size))

    @full_precision
    def to_dense(self) -> Tensor:
        """The whole matrix W, (B, N, N), symmetric. For small images.

        Raises:
            ValueError: if the image has more than 16384 pixels, or not all of them are here.
        """
        check_whole(self.shard, "to_dense")
        pixels = self.factor.shape[2]
        if pixels > DENSE_LIMIT:
            raise ValueError(
                f"the operator must have at most {DENSE_LIMIT} pixels to be dense, got {pixels}; use a smaller image"
            )
        scaled = self.factor * self.scaling.unsqueeze(1)  # F first: without completion U may be too small to square
        return scaled.mT @ scaled + torch.diag_embed(self.remainder)

    @uncompiled
    @full_precision
    def spectrum(self, rank: int | None = None) -> Spectrum:
        """Leading eigenvalues and eigenvectors. Paper: eq. (3), (4).

        Args:
            rank: at most so many; None keeps all that rise above rounding, at most M.

        Raises:
            TypeError, ValueError: if ``rank`` is not a positive integer.
        """
        if rank is not None:
            check_count(rank, "rank")
        remainder = self.remainder if self.kernel.completion == "diagonal" else None
        return compute_spectrum(self.factor, self.scaling, remainder, self.size, rank, self.shard)

    @full_precision
    @torch.no_grad()
    def certify(self) -> "Certificate":
        """Measure whether W is what it promises to be, for the price of a spectrum's Gram matrix and three products.

        Example:
            >>> guide = torch.rand(1, 1, 32, 48, generator=torch.Generator().manual_seed(0))
            >>> certificate = nonlocal_operator(guide, num_landmarks=20).certify()
            >>> certificate.row_sums[0] < 1e-4 and certificate.symmetry[0] < 1e-6
            True
            >>> 0 <= certificate.smallest_eigenvalue[0] and certificate.largest_eigenvalue[0] < 1.0001
            True
        """
        batch, generator = self.factor.shape[0], torch.Generator().manual_seed(0)
        images = torch.randn(1, 2, *self.size, generator=generator, dtype=torch.float64).to(self.factor)
        x, y = images.expand(batch, -1, -1, -1).split(1, dim=1)
        products = torch.cat([x * (self @ y), y * (self @ x)], dim=1).double().sum((2, 3))
        inner = reduce_sum(products, self.shard)
        lengths = reduce_sum(images.double().square().sum((0, 2, 3)), self.shard)
        highest, lowest = (reduce_max((sign * self.remainder).amax(1), self.shard) for sign in (1, -1))
        gram = shifted_gram(self.factor, self.scaling, self.remainder, self.shard)
        return Certificate(
            symmetry=((inner[:, 0] - inner[:, 1]).abs() / lengths.prod().sqrt()).tolist(),
            row_sums=reduce_max((self.row_sums() - 1).abs().amax((1, 2, 3)), self.shard).tolist(),
            smallest_eigenvalue=(-lowest).tolist(),
            largest_eigenvalue=largest_eigenvalue(gram, highest, self.factor.dtype).tolist(),
        )

    @full_precision
    @torch.no_grad()
    def diagnostics(self) -> Diagnostics:
        """Measure how good the operator is. Costs several times as much as the spectrum."""
        spectrum, certificate = self.spectrum(), self.certify()
        vectors = spectrum.eigenvectors  # (B, R, H, W)
        rank = vectors.shape[1]
        image = torch.cat([self.matmul(part) for part in vectors.split(16, dim=1)], dim=1)
        error = (image - spectrum.eigenvalues[:, :, None, None] * vectors).square().sum((2, 3))
        residual = reduce_sum(error, self.shard).sqrt()
        flat = vectors.flatten(2)
        occupied = torch.diag_embed(spectrum.support[:, :rank].to(flat))
        total = moment(self.factor, torch.ones_like(self.scaling).unsqueeze(1), self.shard).to(self.factor)
        kernel_sums = spread(total.mT, self.factor).squeeze(1) + self.diagonal
        bandwidth = torch.as_tensor(self.kernel.photometric_bandwidth).reshape(-1).expand(self.factor.shape[0])
        return Diagnostics(
            pixels=spectrum.pixels,
            num_landmarks=self.factor.shape[1],
            rank=spectrum.support.sum(1).tolist(),
            photometric_bandwidth=bandwidth.tolist(),
            balancing_steps=self.balancing_steps,
            row_sum_residual=certificate.row_sums,
            smallest_row_sum=(-reduce_max(-kernel_sums.amin(1), self.shard)).tolist(),
            largest_eigenvalue=certificate.largest_eigenvalue,
            eigenvector_residual=residual.amax(1).tolist(),
            orthogonality=(reduce_sum(flat @ flat.mT, self.shard) - occupied).abs().amax((1, 2)).tolist(),
            diagonal_share=(reduce_sum(self.diagonal_share.sum((1, 2, 3)), self.shard) / spectrum.pixels).tolist(),
        )


def check_options(
    *,
    num_landmarks: int,
    landmarks: str,
    completion: str,
    guide_channels: str,
    tolerance: float | None,
    generator: torch.Generator | None,
) -> None:
    """Raise unless those options of :func:`nonlocal_operator` are right that can be checked without its guide."""
    check_choice(guide_channels, "guide_channels", ("luminance", "all"))
    remedy = "choose one of these, and pass how many there are as num_landmarks"
    check_choice(landmarks, "landmarks", ("kmeans", "uniform", "random"), remedy)
    check_choice(completion, "completion", ("diagonal", "none"))
    check_count(num_landmarks, "num_landmarks")
    if tolerance is not None:
        check_number(tolerance, "tolerance", "pass a float or None")
        check_positive(tolerance, "tolerance")
    if generator is not None:
        check_instance(generator, torch.Generator, "generator", "make one with torch.Generator()")


def _is_small(bandwidth: float | Tensor | str) -> bool:
    """Whether a photometric bandwidth is one for an image in [0, 1], or ``"auto"``."""
    if isinstance(bandwidth, Tensor):
        return not is_hidden(bandwidth) and bool((bandwidth.detach() < 1).all())
    return isinstance(bandwidth, str) or bandwidth < 1


@uncompiled
@full_precision
def nonlocal_operator(
    guide: Tensor,
    *,
    patch_size: int = 5,
    photometric_bandwidth: float | Tensor | Literal["auto"] = "auto",
    spatial_bandwidth: float | Tensor | None = None,
    num_landmarks: int = 100,
    landmarks: Sampling = "kmeans",
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "luminance",
    patch_weights: Tensor | None = None,
    tolerance: float | None = None,
    generator: torch.Generator | None = None,
    group: Any = None,
) -> NonlocalOperator:
    """The global filter of an image: patches, landmarks, Nystrom factor, completion and balancing.

    Paper: Sec. II, eq. (1), (18), Fig. 2. Runs in float64 for a float64 guide and in float32 for all others, under
    autocast too. Differentiable once in the guide, the bandwidths and the patch weights, with the choice of landmarks
    (for k-means, the assignment of pixels to centroids) held.

    Args:
        guide: (B, C, H, W), finite, usually in [0, 1]; an image, or the feature map of a network. One of 1 or 3
            channels with values above 16 is worth a warning, on processors, if the bandwidth is ``"auto"`` or below 1:
            it is probably in [0, 255].
        patch_size: p, odd, at most 101; pixels outside the image are reflected.
        photometric_bandwidth: h_y in units of the guide (10 / 255 is ten grey levels), a positive number, a tensor of
            shape () or (B,), or ``"auto"``: :func:`estimate_bandwidth`, a constant for gradients.
        spatial_bandwidth: h_x in pixels, likewise; None leaves out the spatial term, so that W is fully nonlocal.
        num_landmarks: M; reduced with a warning where the image has fewer pixels.
        landmarks: ``"kmeans"``, ``"uniform"`` (the paper's grid) or ``"random"``.
        completion: ``"diagonal"`` puts back on the diagonal what the landmarks miss; ``"none"`` is the paper's method,
            which fails at small bandwidths.
        guide_channels: ``"luminance"`` reduces a guide of three channels to one, ``"all"`` compares all of them. Guides
            of another number of channels are taken whole.
        patch_weights: (p, p), non-negative, in place of the Gaussian window; scaled to unit sum.
        tolerance: largest deviation of a row sum from 1; None is 1e-5 in float32 and 1e-12 in float64.
        generator: source of randomness for the landmarks; None draws the same for every call. The global generator is
            never used.
        group: a process group of torch.distributed over whose ranks the rows of one image are spread; ``guide`` is what
            this rank has of them, from the top of the image down. All ranks make the same calls, and get what one
            process would, for their own rows; see :mod:`nlfilter_torch.core.communicator`. None, which
            ``torch.distributed.group.WORLD`` is as well before there is one, is the whole image here.

    Returns:
        The operator, with row sums of 1 to ``tolerance`` or to rounding.

    Raises:
        TypeError, ValueError: naming the argument, what it must be, and what it was.
        ConnectionError: if another rank of the group is gone; it says which.

    Example:
        >>> guide = torch.rand(1, 1, 32, 48, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(guide, photometric_bandwidth=0.2, num_landmarks=20)
        >>> (operator @ guide).shape
        torch.Size([1, 1, 32, 48])
        >>> bool((operator.row_sums() - 1).abs().max() < 1e-4)
        True
    """
    check_image(guide, "guide")
    check_options(
        num_landmarks=num_landmarks,
        landmarks=landmarks,
        completion=completion,
        guide_channels=guide_channels,
        tolerance=tolerance,
        generator=generator,
    )
    if isinstance(photometric_bandwidth, str):
        check_choice(photometric_bandwidth, "photometric_bandwidth", ("auto",), "pass it or a number")
    else:
        check_positive(photometric_bandwidth, "photometric_bandwidth", guide.shape[0])
    if spatial_bandwidth is not None:
        check_positive(spatial_bandwidth, "spatial_bandwidth", guide.shape[0])
    if _is_small(photometric_bandwidth) and not called_by_edit():
        warn_of_scale(guide, "guide")
    guide = reduce_channels(guide.to(working_dtype(guide)), guide_channels)
    shard = meet(guide, group)
    size = (guide.shape[2], guide.shape[3])  # here
    height, width = size if shard is None else (shard.height, shard.width)
    weights = unit_window(patch_size, replicate(patch_weights, shard)).to(guide)
    guide, halo = with_halo(guide, max(weights.shape[0] // 2, 1), shard)
    if isinstance(photometric_bandwidth, str):
        bandwidth: float | Tensor = bandwidth_of_rows(guide, halo, shard)
    else:
        bandwidth = replicate(photometric_bandwidth, shard)
    largest = torch.stack([torch.stack(image.aminmax()).abs().amax() for image in guide.detach()])  # (B,)
    check_scale(bandwidth, "photometric_bandwidth", largest, "values of the guide")
    if spatial_bandwidth is not None:
        farthest = torch.full_like(largest, max(height, width))
        check_scale(spatial_bandwidth, "spatial_bandwidth", farthest, "coordinates")
        spatial_bandwidth = replicate(spatial_bandwidth, shard)
    if num_landmarks > height * width:
        warn(
            f"num_landmarks must be at most the number of pixels, {height * width}, got {described(num_landmarks)}; "
            "using every pixel"
        )
        num_landmarks = height * width

    features = extract_features(
        guide,
        patch_weights=weights,
        photometric_bandwidth=bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        origin=(0 if shard is None else shard.first - halo[0], 0),
        halo=halo,
    )
    points = choose_landmarks(features, (height, width), num_landmarks, landmarks, generator, shard)
    kernel = Kernel(weights, bandwidth, spatial_bandwidth, guide_channels, points, whitener(points), completion)
    bounded = is_bounded(landmarks, height * width, num_landmarks)
    return assemble(features, kernel, size, tolerance=tolerance, bounded=bounded, shard=shard)


def assemble(
    features: Tensor,
    kernel: Kernel,
    size: tuple[int, int],
    *,
    bounded: bool,
    tolerance: float | None = None,
    shard: Shard | None = None,
) -> NonlocalOperator:
    """The operator of pixels with features (B, D, N); ``bounded``, on processors, keeps its eigenvalues at most 1."""
    factor, diagonal = kernel.factor(features)
    completed, watched = kernel.completion == "diagonal", factor.device.type == "cpu"
    balancing = balance(factor, diagonal, tolerance=tolerance, completed=completed, shard=shard)
    before: list[Tensor] = []
    while completed and watched and len(before) < ROUNDS:
        alone = isolated(balancing.scaling.detach())
        if not bool(reduce_max(alone.any().to(factor), shard)):
            break
        before.append(balancing.moment)
        factor, diagonal = factor * ~alone.unsqueeze(1), torch.where(alone, 1.0, diagonal)
        balancing = balance(factor, diagonal, tolerance=tolerance, completed=completed, shard=shard)
    scaling, residual = balancing.scaling, balancing.residual
    remainder = scaling * (scaling * diagonal)  # in this order: without completion d^2 may overflow
    gram = shifted_gram(factor, scaling, remainder, shard)
    if bounded and watched and exceeds(gram, factor):
        limit = limiter(gram, moment(factor, scaling.unsqueeze(1), shard), factor)
        factor, kernel = limit.to(factor) @ factor, replace(kernel, limiter=limit.to(factor))
        before = [torch.linalg.solve(limit.detach(), total) for total in before]  # keeps their products with U
        residual = _residual(factor.detach(), diagonal.detach(), scaling.detach(), shard)
        warn_of_residual(residual, tolerance, factor.dtype, completed=completed)
    return NonlocalOperator(
        factor=factor,
        diagonal=diagonal,
        scaling=scaling,
        size=size,
        kernel=kernel,
        remainder=remainder,
        balancing=PixelScaling(balancing.moment, completed, tuple(before)),
        residual=residual,
        balancing_steps=balancing.steps,
        shard=shard,
    )


def _residual(factor: Tensor, diagonal: Tensor, scaling: Tensor, shard: Shard | None) -> Tensor:
    """Largest deviation of a row sum from 1, (B,)."""
    sums = row_sums(factor, diagonal, scaling, moment(factor, scaling.unsqueeze(1), shard))
    return reduce_max((sums - 1).abs().amax(1), shard)
