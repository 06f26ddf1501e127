"""Building an operator from a guide or from features: landmarks, Nystrom factor, balancing. Paper: Sec. II."""

import math
from dataclasses import replace
from typing import Any, Literal, cast

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_counted,
    check_features,
    check_image,
    check_pixel_weights,
    check_scale,
    check_size,
    check_weights,
    warn_of_scale,
)
from nlfilter_torch.core.communicator import ALONE, Communicator, all_gather_shapes
from nlfilter_torch.core.precision import full_precision, trainable, uncompiled, working_dtype
from nlfilter_torch.core.torch_internals import is_hidden, outside_transforms, refuse_transforms
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.counting import assign_among_counted, extended, hidden_points
from nlfilter_torch.operator.coverage import TRIED, cover
from nlfilter_torch.operator.eigenvalue_bound import exceeds, is_bounded, limiter, slack
from nlfilter_torch.operator.features import (
    GuideFeatures,
    bandwidth_of_rows,
    bandwidth_of_weighted,
    estimate_bandwidth,
    reduce_channels,
    unit_window,
)
from nlfilter_torch.operator.landmarks import landmarks_by
from nlfilter_torch.operator.nystrom import inverse_cholesky
from nlfilter_torch.operator.operator import Kernel, NonlocalOperator
from nlfilter_torch.operator.options import (
    AUTO,
    Assignment,
    Auto,
    Completion,
    FilterOptions,
    GuideChannels,
    Landmarks,
    SpatialBandwidth,
    bandwidths_of,
    check_bandwidths,
    check_options,
    first_count,
    landmark_count,
)
from nlfilter_torch.operator.orientation import Layout
from nlfilter_torch.operator.pixel_matrix import PixelMatrix
from nlfilter_torch.operator.scaling import KernelMatrix, PixelScaling
from nlfilter_torch.operator.sinkhorn import (
    sinkhorn_balance,
    warn_of_residual,
)
from nlfilter_torch.operator.traps import (
    FEW,
    HALF,
    LARGEST_SHARE,
    LEAST_POINTS,
    SAMPLED,
    SampledRows,
    sampled_points,
    share_above,
    warn_of_long_patches,
    warn_of_scale_of_features,
    warn_of_units,
)


def _is_small(bandwidth: float | Tensor | str) -> bool:
    """Whether a photometric bandwidth is ``"auto"`` or below 1, as for an image in [0, 1]."""
    if isinstance(bandwidth, Tensor):
        return not is_hidden(bandwidth) and bool((bandwidth.detach() < 1).all())
    return isinstance(bandwidth, str) or bandwidth < 1


def nonlocal_operator(
    guide: Tensor,
    *,
    patch_size: int = FilterOptions.patch_size,
    photometric_bandwidth: float | Tensor | Literal["auto"] = AUTO,
    spatial_bandwidth: SpatialBandwidth | None = None,
    num_landmarks: int | Auto = FilterOptions.num_landmarks,
    landmarks: Landmarks = FilterOptions.landmarks,
    completion: Completion = FilterOptions.completion,
    guide_channels: GuideChannels = FilterOptions.guide_channels,
    patch_weights: Tensor | None = FilterOptions.patch_weights,
    weights: Tensor | None = None,
    tolerance: float | None = FilterOptions.tolerance,
    generator: torch.Generator | None = FilterOptions.generator,
    group: Any = FilterOptions.group,
) -> NonlocalOperator:
    """Build the global filter of an image: patches, landmarks, Nystrom factor, completion and balancing.

    Paper: Sec. II, eq. (1), (18), Fig. 2. Runs in float64 for a float64 guide and in float32 for all others, also under
    autocast. Differentiable once in the guide, the bandwidths and the patch weights, with the choice of landmarks (for
    k-means, the assignment of pixels to centroids) held fixed.

    Args:
        guide: (B, C, H, W), finite, usually in [0, 1]; an image, or the feature map of a network. A volume, such as a
            scan, is (B, C, D, H, W). On CPUs, a guide of 1 or 3 channels with values above 16 causes a warning if the
            bandwidth is ``"auto"`` or below 1, since it is probably in [0, 255]. So do bandwidths from 4 to 64
            for such a guide in [0, 1], 3 or 4 channels in the last dimension, and a guide of other channels whose scale
            makes W nearly the identity or the mean.
        patch_size: p, odd, at most 101; the image is reflected at its border. Patches of volumes have p^3 voxels.
        photometric_bandwidth: h_y in units of the guide (10 / 255 is ten grey levels), a positive number, a tensor of
            shape () or (B,), or ``"auto"``: :func:`estimate_bandwidth`, a constant for gradients.
        spatial_bandwidth: h_x in pixels, a positive number or a tensor of shape () or (B,), or two of them, for
            vertical and horizontal distances (of volumes three, for depth first); None leaves out the spatial term, so
            that W is fully nonlocal.
        num_landmarks: M; reduced with a warning where the image has fewer pixels. ``"auto"`` takes as many, up to 1000,
            as cover all but 3 % of the points (:meth:`NonlocalOperator.badly_covered`) in the worst image of a batch,
            and warns if these are not enough; not with a group.
        landmarks: ``"kmeans"``, ``"uniform"`` (the paper's grid) or ``"random"``, chosen anew in every call. Or an
            operator built before, whose landmarks are kept: for a guide of the same size, the assignment of pixels to
            landmarks is held, and the landmarks move smoothly with guide and bandwidths; for any other, its landmarks
            are taken as they are, as constants. Or ``operator.assignment``, which refuses guides of another size. Or
            features (B, D, M) or (1, D, M), such as ``operator.landmarks``, divided by the bandwidths like those of the
            pixels; differentiable. ``num_landmarks`` is then ignored.
        completion: ``"diagonal"`` corrects the diagonal of the kernel to 1; ``"none"`` is the paper's method, which
            fails at small bandwidths.
        guide_channels: ``"luminance"`` reduces a guide of three channels to one, ``"all"`` compares all of them. A
            guide with any other number of channels is used unchanged.
        patch_weights: (p, p), or (p, p, p) for volumes, non-negative, replaces the Gaussian window; scaled to unit sum.
        weights: (B, 1, H, W) or (1, 1, H, W), how much each pixel counts: 0 for padding, hidden or unknown pixels, and
            otherwise from 1e-6 to 1e6; None means 1 each. Where they are 0 the guide is not read: patches, landmarks
            and ``"auto"`` know only pixels that count, and patches mirror at their edge, so that the results of a
            padded image are those of the image. Pixels of weight 0 are filtered from those that count. Constant for
            gradients; not with a group.
        tolerance: largest deviation of a row sum from 1; None means 1e-5 in float32 and 1e-12 in float64.
        generator: source of randomness for the landmarks; with None every call draws the same. The global generator is
            never used.
        group: a torch.distributed process group over whose ranks the rows of one image are distributed; ``guide`` then
            holds the rows of this rank, or the slices of a volume, in rank order from top to bottom. All ranks make the
            same calls, and each gets the single-process result for its own rows; see
            :mod:`nlfilter_torch.core.communicator`. None, or ``torch.distributed.group.WORLD`` before it is
            initialised, means that this process holds the whole image.

    Returns:
        The operator, with row sums of 1 to within ``tolerance`` or rounding.

    Raises:
        TypeError, ValueError: for an invalid argument; the message says what it must be and what it was.
        ConnectionError: if another rank of the group is gone; the message names it.

    Example:
        >>> guide = torch.rand(1, 1, 32, 48, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(guide, photometric_bandwidth=0.2, num_landmarks=20)
        >>> (operator @ guide).shape
        torch.Size([1, 1, 32, 48])
        >>> bool((operator.row_sums() - 1).abs().max() < 1e-4)
        True
    """
    count, covering = first_count(num_landmarks)
    options = FilterOptions(  # written out: older versions of torch's compiler do not know ``locals()``
        patch_size=patch_size,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        num_landmarks=count,
        covering=covering,
        landmarks=landmarks,
        completion=completion,
        guide_channels=guide_channels,
        patch_weights=patch_weights,
        tolerance=tolerance,
        generator=generator,
        group=group,
    )
    return checked_operator(guide, options, weights)


def checked_operator(guide: Tensor, options: FilterOptions, weights: Tensor | None = None) -> NonlocalOperator:
    """:func:`nonlocal_operator`, with its options as one value."""
    return (_checked_uncompiled if _is_uncompiled(options, weights) else _checked)(guide, options, weights)


@outside_transforms
@full_precision
def _checked(guide: Tensor, options: FilterOptions, weights: Tensor | None) -> NonlocalOperator:
    _check_guide(guide, options)
    if weights is not None:
        weights = check_pixel_weights(weights, guide, options.group)
        guide = torch.where(weights > 0, guide, 0.0)  # large values there are no mistake
    bandwidth = cast(float | Tensor | str, options.photometric_bandwidth)  # None was refused
    if not is_hidden(guide) and _is_small(bandwidth):
        warn_of_scale(guide, "guide")
    warn_of_units(guide, bandwidth)
    warn_of_long_patches(guide, options.patch_size)
    operator = _from_guide(guide, options, weights)
    if options.completion == "diagonal" and weights is None and operator.communicator.size == 1:
        warn_of_scale_of_features(operator.scaling, guide, bandwidth)
    return operator


_checked_uncompiled = uncompiled(_checked)


def _is_uncompiled(options: FilterOptions, weights: Tensor | None) -> bool:
    """Whether an operator depends on what cannot be compiled."""
    return options.covering or options.generator is not None or options.group is not None or weights is not None


def operator_from_guide(guide: Tensor, options: FilterOptions, weights: Tensor | None = None) -> NonlocalOperator:
    """:func:`nonlocal_operator` for a guide whose scale has been checked: without the warning about values above 16.

    ``weights`` (B, 1, H, W) are in range, have the dtype of the guide, and are not 0 in all pixels of an image. Where
    they are 0, patches read the guide as it is: :func:`fill_nearby` has filled it.
    """
    return (_built_uncompiled if _is_uncompiled(options, weights) else _built)(guide, options, weights)


@outside_transforms
@full_precision
def _built(guide: Tensor, options: FilterOptions, weights: Tensor | None) -> NonlocalOperator:
    _check_guide(guide, options)
    return _from_guide(guide, options, weights, filled=True)


_built_uncompiled = uncompiled(_built)


def _check_guide(guide: Tensor, options: FilterOptions) -> None:
    """Raise an error for an invalid guide or option."""
    if isinstance(guide, NonlocalOperator):
        raise TypeError("guide must be a torch.Tensor, got a NonlocalOperator, which is built already; use it as it is")
    refuse_transforms(
        guide=guide,
        photometric_bandwidth=options.photometric_bandwidth,
        spatial_bandwidth=bandwidths_of(options.spatial_bandwidth),
        patch_weights=options.patch_weights,
        landmarks=options.landmarks,
    )
    check_image(guide, "guide", empty=True, dimensions=(4, 5))
    check_options(options)
    axes, window = guide.ndim - 2, options.patch_weights
    check_bandwidths(options, guide.shape[0], axes)
    if isinstance(window, Tensor) and window.ndim in (2, 3) and window.ndim != axes:
        raise ValueError(
            f"patch_weights must have the {axes} axes of the guide, got {tuple(window.shape)}; "
            f"pass ({', '.join('p' * axes)})"
        )


def _from_guide(
    guide: Tensor, options: FilterOptions, weights: Tensor | None = None, *, filled: bool = False
) -> NonlocalOperator:
    """Build an operator from a checked guide, checked options and weights (B, 1, H, W).

    With ``filled``, patches read the guide also where weights are 0.
    """
    guide = reduce_channels(trainable(guide).to(working_dtype(guide)), options.guide_channels)
    communicator = all_gather_shapes(guide, options.group)
    size = tuple(guide.shape[2:])  # of the rows of this rank
    patch_weights = communicator.copy_to_group(options.patch_weights)
    window = unit_window(options.patch_size, patch_weights, len(size)).to(guide)
    guide, halo = communicator.with_halo(guide, max(window.shape[0] // 2, 1))
    counts = None if weights is None or filled else weights > 0
    bandwidth = _bandwidth(guide, halo, options, communicator, weights, counts)
    spatial = options.spatial_bandwidth
    if not is_hidden(guide):
        ends = [image.aminmax() for image in guide.detach()]  # faster on CPUs than those of all images
        largest = [max(-float(least), float(most)) for least, most in ends]
        check_scale(bandwidth, "photometric_bandwidth", largest, guide.dtype, "values of the guide")
        farthest = [float(max(communicator.whole(size)))] * len(guide)
        for axis_bandwidth in () if spatial is None else bandwidths_of(spatial):
            check_scale(axis_bandwidth, "spatial_bandwidth", farthest, guide.dtype, "coordinates")
    if spatial is not None:
        spatial = tuple(_copy(communicator.copy_to_group(value)) for value in bandwidths_of(spatial))
    recipe = GuideFeatures(window, _copy(bandwidth), spatial, options.guide_channels)
    features = recipe(guide, origin=(communicator.first_row - halo[0], 0), halo=halo, counts=counts)
    weights = None if weights is None else weights.flatten(1)
    return _assemble(features, size, options, recipe=recipe, weights=weights, communicator=communicator)


def _bandwidth(
    guide: Tensor,
    halo: tuple[int, int],
    options: FilterOptions,
    communicator: Communicator,
    weights: Tensor | None,
    counts: Tensor | None,
) -> float | Tensor:
    """The photometric bandwidth, estimated from the guide, or where it ``counts``, if it is ``"auto"``."""
    if not isinstance(options.photometric_bandwidth, str):
        bandwidth: float | Tensor = communicator.copy_to_group(options.photometric_bandwidth)
        return bandwidth
    if weights is not None:
        return bandwidth_of_weighted(guide, weights, counts)
    return bandwidth_of_rows(guide, halo, communicator)


@uncompiled
@outside_transforms
@full_precision
def operator_from_features(
    features: Tensor,
    *,
    size: tuple[int, ...],
    weights: Tensor | None = None,
    num_landmarks: int | Auto = FilterOptions.num_landmarks,
    landmarks: Landmarks = FilterOptions.landmarks,
    completion: Completion = FilterOptions.completion,
    tolerance: float | None = FilterOptions.tolerance,
    generator: torch.Generator | None = FilterOptions.generator,
    group: Any = FilterOptions.group,
) -> NonlocalOperator:
    """Build the filter of any points from their features: landmarks, Nystrom factor, completion and balancing.

    Points may be the pixels of an image, every n-th of them, a weighted sample, the voxels of a volume, a point cloud.
    :func:`nonlocal_operator` applies the same steps to the weighted patches of a guide. Its k-means landmarks turn with
    the image; those of points depend on their order.

    Args:
        features: (B, D, N), already divided by bandwidths: the affinity of two points is ``exp(-|x_i - x_j|^2)``. On
            CPUs, 1,024 points or more cause a warning if the landmarks cover more than 15 % of them badly; see
            :meth:`NonlocalOperator.badly_covered`.
        size: (H, W) with H * W = N, the shape of the images to filter; (D, H, W) for volumes, and so on; (N,), meaning
            (1, N), for unordered points. Values (B, C, N) can be filtered whatever the size.
        weights: (N,) or (B, N): how many identical pixels each point represents, 0 for points that do not count, which
            are filtered from those that do. With ``"kmeans"``, landmarks are drawn in proportion to the weights,
            averaged over a batch. None means one each. Constant for gradients.
        num_landmarks: M; reduced with a warning where there are fewer points; or ``"auto"``.
        landmarks: as for :func:`nonlocal_operator`; features have the meaning and scale of ``features``.
        completion: as for :func:`nonlocal_operator`.
        tolerance: as for :func:`nonlocal_operator`.
        generator: as for :func:`nonlocal_operator`.
        group: as for :func:`nonlocal_operator`; ``features`` and ``size`` are then those of the rows of this rank.

    Returns:
        The operator. Differentiable once in the features.

    Raises:
        TypeError, ValueError: for an invalid argument; the message says what it must be and what it was.

    Example:
        >>> points = torch.rand(1, 3, 500, generator=torch.Generator().manual_seed(0))
        >>> operator = operator_from_features(points / 0.3, size=(500,), num_landmarks=20)
        >>> smoothed = operator @ torch.ones(1, 1, 500)
        >>> bool((smoothed - 1).abs().max() < 1e-4)
        True
    """
    num_landmarks, covering = first_count(num_landmarks)
    options = FilterOptions.of(locals())
    operator = _from_points(features, size, options, weights)
    _warn_of_coverage(operator)
    return operator


@uncompiled
@outside_transforms
@full_precision
def operator_from_points(
    features: Tensor, size: tuple[int, ...], options: FilterOptions, weights: Tensor | None = None
) -> NonlocalOperator:
    """:func:`operator_from_features` where a user did not choose the points: without the warning about landmarks."""
    return _from_points(features, size, options, weights)


def _from_points(
    features: Tensor, size: tuple[int, ...], options: FilterOptions, weights: Tensor | None
) -> NonlocalOperator:
    """Check and build, outside of transforms; leaving them twice would hide what is transformed."""
    refuse_transforms(features=features, weights=weights, landmarks=options.landmarks)
    check_features(features, "features", empty=True)
    check_options(options)
    shape = check_size(size, features.shape[2])
    features = features.to(working_dtype(features))
    if weights is not None:
        weights = check_weights(weights, features)
    communicator = all_gather_shapes(features.unflatten(2, shape), options.group)
    if weights is not None:
        check_counted(communicator.max(weights.amax(1)))
    return _assemble(features, shape, options, weights=weights, communicator=communicator)


def _warn_of_coverage(operator: NonlocalOperator) -> None:
    """Warn if the landmarks cover many points badly; not of few points, hidden values and distributed rows."""
    points = operator.factor.shape[2]
    if points < LEAST_POINTS or len(operator) == 0 or is_hidden(operator.factor) or operator.communicator.size > 1:
        return
    # Where the correction of the diagonal is below half, the row is not off by more: |K_ij - u_i . u_j|^2 <= c_i c_j.
    uncertain = share_above(operator.diagonal.detach(), HALF, operator.weights)
    worst, share = operator[int(uncertain.argmax())], float(uncertain.max())
    for count in (FEW, SAMPLED):
        if share <= LARGEST_SHARE:
            return
        share = float(worst.badly_covered(count))
    if share > LARGEST_SHARE:
        warn(
            f"landmarks must resemble the points, got {operator.factor.shape[1]} of them that leave rows of W of "
            f"{share:.0%} of the points off by more than half; use more landmarks, or a larger bandwidth"
        )


def _copy(value: float | Tensor) -> float | Tensor:
    """Copy a tensor, since the caller may change it in place."""
    return value.clone() if isinstance(value, Tensor) else value


def sampled_operator(
    guide: Tensor,
    places: Tensor,
    options: FilterOptions,
) -> NonlocalOperator:
    """:func:`nonlocal_operator` of some pixels of a guide, each of which stands for as many others.

    Landmarks are those of the whole guide (1, 1, H, W); results at these pixels equal those of the whole guide, up to
    the error of sums over a sample. ``places`` (n,) are row-major indices of pixels that are spread evenly over the
    picture, and ``options`` choose the landmarks. The images of the operator have the size (1, n).
    """
    check_options(options)
    check_bandwidths(options)
    bandwidth = options.bandwidth_or(lambda: estimate_bandwidth(guide))
    recipe = GuideFeatures.of(options, bandwidth, guide.dtype, guide.device)
    features, size = recipe(guide), (guide.shape[2], guide.shape[3])
    chosen, _ = landmarks_by(features, size, options, layout=recipe.layout)
    count = len(places)
    weights = guide.new_full((1, count), features.shape[2] / count)
    return _assemble(features[:, :, places], (1, count), options, recipe=recipe, weights=weights, chosen=chosen)


def _assemble(
    features: Tensor,
    size: tuple[int, ...],
    options: FilterOptions,
    *,
    recipe: GuideFeatures | None = None,
    weights: Tensor | None = None,
    communicator: Communicator = ALONE,
    chosen: Tensor | None = None,
) -> NonlocalOperator:
    """Build an operator from features (B, D, N), which ``recipe`` computed if they come from a guide.

    Landmarks (B, D, M) are chosen by the options unless they are already ``chosen``.
    """
    whole = communicator.whole(size)
    hidden = hidden_points(weights)
    points, tolerance = math.prod(whole), options.tolerance
    if hidden is not None and communicator.size == 1:
        points = int((~hidden).sum(1).min())
    if features.shape[0] == 0:
        return _empty(features, size, landmark_count(options, points), options.completion, recipe)
    assignment = None
    if chosen is None:
        choose = _covering if options.covering else _landmarks
        layout = None if recipe is None else recipe.layout
        chosen, assignment = choose(features, whole, options, communicator, weights, layout, points)
    inverse = inverse_cholesky(chosen)
    sample = None
    if communicator.size == 1 and not torch.compiler.is_compiling():  # ranks send nothing that only diagnostics need
        sample = communicator.columns(features.detach(), sampled_points(math.prod(whole)).to(features.device))
    kernel = Kernel(chosen, inverse, options.completion, features=recipe, assignment=assignment, sample=sample)
    factor, diagonal = whole_kernel = kernel.factor(features)
    if hidden is not None:  # set aside, with row sums of 1
        factor, diagonal = factor * ~hidden.unsqueeze(1), torch.where(hidden, 1.0, diagonal)
    completed, watched = options.completion == "diagonal", not is_hidden(factor)
    matrix = KernelMatrix(factor, diagonal, weights, communicator)
    bound = options.landmarks != "kmeans"
    balancing = sinkhorn_balance(matrix, tolerance=tolerance, completed=completed, bound=bound)
    matrix, scaling, residual, before = balancing.matrix, balancing.scaling, balancing.residual, balancing.before
    factor, diagonal = matrix.factor, matrix.diagonal
    worst = balancing.worst if watched else 0.0
    remainder = scaling * (scaling * diagonal)  # in this order: without completion d^2 may overflow
    over, allowed = None, slack(factor.dtype, worst)
    if watched and is_bounded(options.landmarks, points, chosen.shape[2]):
        gram = PixelMatrix(factor, scaling, remainder, weights, communicator).gram_below
        over = exceeds(gram, balancing.moment, allowed)
    if over is not None and bool(over.any()):
        factor, limit = _limited(matrix, scaling, remainder, over, allowed)
        kernel = replace(kernel, limiter=limit)
        before = tuple(torch.linalg.solve(limit.detach().double(), total) for total in before)  # preserves u . total
        matrix = replace(matrix, factor=factor)
        residual = _residual(matrix, scaling)
        warn_of_residual(float(residual.max()), tolerance, factor.dtype, completed=completed)
    if hidden is not None:
        columns, own = whole_kernel
        columns = columns if kernel.limiter is None else kernel.limiter @ columns
        factor, diagonal, scaling = extended(matrix, scaling, columns, own, hidden, completed=completed)
        remainder = scaling * (scaling * diagonal)
    return NonlocalOperator(
        factor=factor,
        diagonal=diagonal,
        scaling=scaling,
        size=size,
        kernel=kernel,
        remainder=remainder,
        balancing=PixelScaling(balancing.moment, completed, worst, before, _least(weights, communicator)),
        residual=residual,
        balancing_steps=balancing.steps,
        weights=weights,
        communicator=communicator,
    )


def _limited(
    matrix: KernelMatrix, scaling: Tensor, remainder: Tensor, over: Tensor, allowed: float
) -> tuple[Tensor, Tensor]:
    """The factor (B, M, N) with eigenvalues of at most 1, and by which matrices (B, M, M) it was multiplied.

    Only images that are ``over``, (B,), change: their matrices need an eigen-decomposition.
    """
    factor, weights, communicator = matrix.factor, matrix.weights, matrix.communicator
    if bool(over.all()):
        gram = PixelMatrix(factor, scaling, remainder, weights, communicator).gram_below
        limit = limiter(gram, matrix.moment(scaling), allowed).to(factor)
        return limit @ factor, limit
    index = over.nonzero().squeeze(1)
    weights = weights if weights is None or len(weights) == 1 else weights[index]
    part = KernelMatrix(factor[index], matrix.diagonal[index], weights, communicator)
    columns, limit = _limited(part, scaling[index], remainder[index], over[index], allowed)
    identity = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device).expand(len(factor), -1, -1)
    replaced = factor.index_copy if factor.requires_grad else factor.index_copy_  # nothing else holds this factor
    return replaced(0, index, columns), identity.index_copy(0, index, limit)


def _landmarks(
    features: Tensor,
    size: tuple[int, ...],
    options: FilterOptions,
    communicator: Communicator,
    weights: Tensor | None,
    layout: Layout | None,
    points: int,
) -> tuple[Tensor, Assignment | None]:
    """:func:`landmarks_by`, at most as many as ``points`` that count, and from these alone where weights are 0."""
    count = landmark_count(options, points)
    options = options if count == options.num_landmarks else replace(options, num_landmarks=count)
    named = isinstance(options.landmarks, str)
    if weights is None or communicator.size > 1 or not named or (layout is None and hidden_points(weights) is None):
        return landmarks_by(features, size, options, communicator, weights, layout)
    return assign_among_counted(features, size, options, weights, layout)


def _covering(
    features: Tensor,
    size: tuple[int, ...],
    options: FilterOptions,
    communicator: Communicator,
    weights: Tensor | None,
    layout: Layout | None,
    points: int,
) -> tuple[Tensor, Assignment | None]:
    """:func:`_landmarks`, as many as cover the points."""
    if not isinstance(options.landmarks, str):  # given ones, whose number is known
        return _landmarks(features, size, options, communicator, weights, layout, points)
    if communicator.size > 1 or is_hidden(features):
        raise ValueError(
            "num_landmarks must be a number with a group or for values that are not known, got 'auto'; take that of an "
            "operator of a reduced image"
        )
    state = None if options.generator is None else options.generator.get_state()
    exact: list[Tensor] = []  # rows of the exact filter of the sample, once the first trial has computed them

    def trial(count: int) -> tuple[float, tuple[Tensor, Assignment | None]]:
        if options.generator is not None and state is not None:
            options.generator.set_state(state)  # the last trial gives what its number gives when asked for at once
        wanted = replace(options, num_landmarks=count, covering=False)
        result = _landmarks(features, size, wanted, communicator, weights, layout, points)
        return _badly_covered(features.detach(), wanted, weights, result[0].detach(), exact), result

    return cover(trial, points)


@torch.no_grad()
def _badly_covered(
    features: Tensor, options: FilterOptions, weights: Tensor | None, landmarks: Tensor, exact: list[Tensor]
) -> float:
    """Share of the points of the worst image that landmarks (B, D, M) cover badly, without an operator of all points.

    The filter of some points, each of which stands for as many others, gives the balancing; see
    :meth:`NonlocalOperator.badly_covered` for the rest. ``exact`` keeps what is the same for all landmarks.
    """
    points = features.shape[2]
    places, sample = (sampled_points(points, count).to(features.device) for count in (TRIED, SAMPLED))
    counted = features.new_ones(len(features), points) if weights is None else weights.expand(len(features), -1)
    stands_for = counted[:, places] * (points / len(places))
    few = _assemble(features[:, :, places], (1, len(places)), options, weights=stands_for, chosen=landmarks)
    kept = features[:, :, sample]
    columns, weight, every = few.at(kept), counted[:, sample], points / len(sample)
    rows = SampledRows(kept, columns.factor, columns.scaling, columns.remainder, weight, every)
    return float(rows.badly_covered(exact).max())


def _least(weights: Tensor | None, communicator: Communicator) -> Tensor | None:
    """The smallest weight of the points that count, (B, 1)."""
    if weights is None:
        return None
    return -communicator.max(-torch.where(weights > 0, weights, torch.inf).amin(1, keepdim=True))


@torch.no_grad()
def _residual(matrix: KernelMatrix, scaling: Tensor) -> Tensor:
    """Largest deviation of a row sum of W from 1, (B,)."""
    sums = matrix.row_sums(scaling, matrix.moment(scaling))
    return matrix.communicator.max((sums - 1).abs().amax(1))


def _empty(
    features: Tensor, size: tuple[int, ...], count: int, completion: Completion, recipe: GuideFeatures | None
) -> NonlocalOperator:
    """The operator of an empty batch of features (0, D, N)."""
    per_pixel, total = features.new_empty(0, features.shape[2]), features.new_empty(0, count, 1, dtype=torch.float64)
    landmarks = features.new_empty(0, features.shape[1], count)
    kernel = Kernel(landmarks, features.new_empty(0, count, count), completion, features=recipe)
    return NonlocalOperator(
        factor=features.new_empty(0, count, features.shape[2]),
        diagonal=per_pixel,
        scaling=per_pixel,
        size=size,
        kernel=kernel,
        remainder=per_pixel,
        balancing=PixelScaling(total, completion == "diagonal"),
        residual=features.new_empty(0),
        balancing_steps=0,
    )
