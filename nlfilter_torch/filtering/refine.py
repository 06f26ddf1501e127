"""Refining coarse probabilities, logits, masks and trimaps to the edges of an image, by mean-field steps with W.

Every step adds the average of the probabilities of similar pixels, ``W q``, to the logits: the mean-field inference of
a dense conditional random field (P. Kraehenbuehl, V. Koltun, "Efficient Inference in Fully Connected CRFs with Gaussian
Edge Potentials", 2011), with balanced affinities in place of a filter on a lattice.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_choice,
    check_count,
    check_dtype,
    check_finite,
    check_image,
    check_positive,
    check_same_size,
    check_unit_range,
    check_values,
    described,
)
from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.core.precision import full_precision, per_image, working_dtype
from nlfilter_torch.core.torch_internals import in_format_of, is_hidden
from nlfilter_torch.operator.build import checked_operator
from nlfilter_torch.operator.features import estimate_bandwidth
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import AUTO, SAMPLING, FilterOptions, GuideChannels, Sampling, SpatialBandwidth

Kind = Literal["logits", "probabilities", "mask", "trimap"]
KINDS = ("logits", "probabilities", "mask", "trimap")

STRENGTH, MARGIN, CAUTION = 4.0, 2.5, 0.2  # defaults, chosen on composites of five classes
FLOOR = 1e-6  # of probabilities, whose logarithms are taken
STEEPEST = 100.0  # largest factor of logits, so that noise on constant ones is not taken for classes
PHOTOMETRIC = 0.5  # bandwidth, relative to that of estimate_bandwidth, which is made for detail
SPATIAL = 0.55  # bandwidth, relative to the width of the transitions between classes
NARROWEST, WIDEST = 1 / 20, 1 / 6  # spatial bandwidth, relative to the short side
CONFIDENT = 4  # power of probabilities that makes confident pixels count most


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanField:
    """How logits are refined with a given operator; see :func:`refine` for the meaning of the options."""

    steps: int = 5
    strength: float | Tensor = STRENGTH
    margin: float | Tensor | None = MARGIN
    compatibility: Tensor | None = None
    caution: float | Tensor | Literal["auto"] | None = AUTO


#: The filter by default.
FILTER = FilterOptions(patch_size=1, spatial_bandwidth=AUTO, num_landmarks=250, guide_channels="all")


def refine(
    logits: Tensor,
    guide: Tensor | NonlocalOperator,
    *,
    kind: Kind = "logits",
    confidence: Tensor | None = None,
    steps: int = MeanField.steps,
    strength: float | Tensor = MeanField.strength,
    margin: float | Tensor | None = MeanField.margin,
    compatibility: Tensor | None = MeanField.compatibility,
    caution: float | Tensor | Literal["auto"] | None = MeanField.caution,
    patch_size: int = FILTER.patch_size,
    photometric_bandwidth: float | Tensor | Literal["auto"] = AUTO,
    spatial_bandwidth: SpatialBandwidth | Literal["auto"] | None = AUTO,
    num_landmarks: int = FILTER.num_landmarks,
    landmarks: Sampling = SAMPLING,
    guide_channels: GuideChannels = FILTER.guide_channels,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Align coarse logits, probabilities, a mask or a trimap with the edges of an image.

    Every step averages the probabilities of similar pixels and adds the average to the logits:
    ``q <- softmax(logits + strength * W q)``, as in a dense conditional random field.

    Args:
        logits: (B, K, H, W): ``kind`` says what they are. Coarse ones are first interpolated to the size of the guide.
        guide: the image, (B, C, H, W), or its operator, in which case the options from ``patch_size`` on are left out.
            A batch of 1, of either argument, serves for all of the other.
        kind: ``"logits"``, of K classes, or of one class against the background if K is 1; ``"probabilities"`` of at
            least two classes in [0, 1], scaled to unit sum; ``"mask"``, (B, 1, H, W) in [0, 1], the probability of an
            object; or ``"trimap"``, (B, 1, H, W), where 0 is background, 1 the object, and all between unknown.
        confidence: (B, 1, H, W) in [0, 1], how far each pixel of the input is trusted; 0 means unknown. None trusts all
            of them (in a trimap, the known ones).
        steps: number of steps.
        strength: at least 0, a number or a tensor of shape () or (B,): the weight of similar pixels.
        margin: positive, a number or a tensor of shape () or (B,): logits are scaled so that the largest exceeds the
            second by this much in the mean, since networks are confident to very different degrees; None keeps them.
        compatibility: (K, K), finite: how much similar pixels of class j (column) speak for class i (row); None is the
            identity. A mask or a single logit has two classes, the background first.
        caution: positive, a number or a tensor of shape () or (B,): if refinement takes more than this share of the
            doubt that the input itself has about its confident pixels, averaged over classes, then input and result are
            blended, so that bad bandwidths do little harm. None takes the result as it is; ``"auto"`` is 0.2 if a
            bandwidth or an operator is passed, and None if both bandwidths are chosen from the data.
        patch_size: as for :func:`nonlocal_operator`.
        photometric_bandwidth: as for :func:`nonlocal_operator`; ``"auto"`` is 0.5 times :func:`estimate_bandwidth`.
        spatial_bandwidth: as for :func:`nonlocal_operator`; ``"auto"`` is 0.55 times the mean width of the transitions
            between the classes of the input, within 1/20 and 1/6 of the short side. Both are constants for gradients.
        num_landmarks: as for :func:`nonlocal_operator`.
        landmarks: as for :func:`nonlocal_operator`.
        guide_channels: as for :func:`nonlocal_operator`.
        generator: as for :func:`nonlocal_operator`.

    Returns:
        (B, K, H, W) in the dtype of the input. Logits come back as logarithms of probabilities (a single one as their
        difference), a trimap as a mask that keeps its known pixels, the other kinds as they are. Differentiable in
        input, guide, confidence and parameters.

    Raises:
        TypeError, ValueError: if sizes or batches differ, values are out of range or not finite, no pixel is trusted or
            known, or an option is not valid.

    Example:
        >>> image = torch.full((1, 1, 32, 32), 0.2)
        >>> image[..., 13:] = 0.8
        >>> bright = image > 0.5
        >>> eighth = torch.nn.functional.avg_pool2d(bright.float(), 8)  # the mask at an eighth of the resolution
        >>> coarse = torch.nn.functional.interpolate(eighth, scale_factor=8, mode="bilinear")
        >>> refined = refine(coarse, image, kind="mask", num_landmarks=50)
        >>> int(((coarse > 0.5) != bright).sum()), int(((refined > 0.5) != bright).sum())  # wrong pixels
        (32, 0)
    """
    options = FILTER.updated(locals())
    method = MeanField(steps=steps, strength=strength, margin=margin, compatibility=compatibility, caution=caution)
    return refined(logits, guide, kind, confidence, method, options)


@full_precision
def refined(
    logits: Tensor,
    guide: Tensor | NonlocalOperator,
    kind: Kind,
    confidence: Tensor | None,
    method: MeanField,
    options: FilterOptions,
) -> Tensor:
    """:func:`refine`, with the options of its steps and those of its filter as one value each."""
    _check_input(logits, kind)
    confidence = _checked_confidence(logits, kind, confidence)
    communicator = guide.communicator if isinstance(guide, NonlocalOperator) else ALONE
    images = _check_guide(logits, guide, options)
    _check_options(method, options, logits, images)
    if isinstance(method.caution, str):
        chosen = isinstance(options.photometric_bandwidth, str) and isinstance(options.spatial_bandwidth, str)
        caution = None if chosen and not isinstance(guide, NonlocalOperator) else CAUTION
        method = replace(method, caution=caution)
    unary = _scaled(_as_logits(logits, kind), confidence, method.margin, communicator)
    if not isinstance(guide, NonlocalOperator):
        guide = build_operator(guide, unary, confidence, options)
    energies = mean_field(guide, unary, confidence, method)
    return in_format_of(_as_kind(energies, logits, kind), logits)


def mean_field(operator: NonlocalOperator, unary: Tensor, confidence: Tensor | None, method: MeanField) -> Tensor:
    """Refine logarithms of probabilities (B, K, H, W), and return new ones."""
    strength = per_image(method.strength, unary, 4)
    start = unary.exp()
    trusted = unary if confidence is None else confidence * unary
    probabilities = start
    if confidence is not None:  # unknown pixels start from similar known ones
        extended = (operator @ torch.cat([confidence * start, confidence.expand_as(start[:, :1])], dim=1)).clamp(min=0)
        known = extended[:, -1:].clamp(min=FLOOR)
        probabilities = confidence * start + (1 - confidence) * extended[:, :-1] / known
    energies = trusted
    for _ in range(method.steps):
        message = operator @ probabilities
        if method.compatibility is not None:
            message = torch.einsum("ij,bjhw->bihw", method.compatibility.to(message), message)
        energies = trusted + strength * message
        probabilities = energies.softmax(1)
    if method.caution is not None and not isinstance(method.caution, str):
        share = _share_of_result(start, probabilities, confidence, method.caution, operator.communicator)
        energies = torch.lerp(trusted.expand_as(energies), energies, share)
    return energies.log_softmax(1)


def _share_of_result(
    start: Tensor,
    probabilities: Tensor,
    confidence: Tensor | None,
    caution: float | Tensor,
    communicator: Communicator,
) -> Tensor:
    """The weight (B, 1, 1, 1) of refined probabilities (B, K, H, W); the rest is that of the input ``start``.

    Compared are the means over classes of the probability that confident pixels of a class lose, and of the doubt that
    the input has about them. On composites, the loss tells bandwidths that are too large from good ones (its
    correlation with the change in mIoU is -0.96), and counts small classes, which vanish first, as much as large ones.
    """
    highest = start == start.amax(1, keepdim=True)
    weights = start**CONFIDENT * highest
    weights = weights if confidence is None else weights * confidence
    sums = [(weights * part).sum((2, 3)) for part in (1 - probabilities, 1 - start, torch.ones_like(start))]
    lost, doubt, total = communicator.sum(torch.stack([part.expand_as(sums[0]) for part in sums])).unbind()
    total = total.clamp(min=torch.finfo(total.dtype).tiny)
    lost, doubt = (lost / total).sum(1), (doubt / total).sum(1)  # (B,)
    allowed = per_image(caution, start, 1) * doubt
    ratio = (allowed / lost.clamp(min=FLOOR)).clamp(max=1.0)
    return ratio.square().reshape(-1, 1, 1, 1)


def build_operator(guide: Tensor, unary: Tensor, confidence: Tensor | None, options: FilterOptions) -> NonlocalOperator:
    """Build the operator of a guide, with bandwidths from guide and input where they are ``"auto"``."""
    photometric = options.bandwidth_or(lambda: PHOTOMETRIC * estimate_bandwidth(guide))
    spatial = options.spatial_bandwidth
    if isinstance(spatial, str):
        spatial = _transition_bandwidth(unary.detach(), None if confidence is None else confidence.detach())
        if len(guide) == 1 < len(spatial):
            spatial = spatial.mean(0)
        elif len(spatial) == 1:
            spatial = spatial.squeeze(0)
    count = options.num_landmarks
    # The default, which nobody chose, needs no warning where an image has fewer pixels.
    if isinstance(count, int) and count == FILTER.num_landmarks:
        count = min(count, guide.shape[2] * guide.shape[3])
    return checked_operator(
        guide, replace(options, photometric_bandwidth=photometric, spatial_bandwidth=spatial, num_landmarks=count)
    )


def _transition_bandwidth(unary: Tensor, confidence: Tensor | None) -> Tensor:
    """Spatial bandwidth, (B,), from the width of the transitions between classes.

    A linear transition of width s between two classes holds a third of s times its length in ``1 - sum q^2``; the
    length is half the total variation. The unknown part of a trimap is a transition, too.
    """
    probabilities = unary.exp()
    if confidence is not None:
        probabilities = confidence * probabilities + (1 - confidence) / probabilities.shape[1]
    doubt = (1 - probabilities.square().sum(1)).sum((1, 2))
    length = sum(probabilities.diff(dim=axis).abs().sum((1, 2, 3)) for axis in (2, 3)) / 2
    short = min(unary.shape[2:])
    width = 3 * doubt / torch.as_tensor(length).to(doubt).clamp(min=FLOOR)
    return (SPATIAL * width).clamp(min=NARROWEST * short, max=WIDEST * short)


def _scaled(
    logits: Tensor, confidence: Tensor | None, margin: float | Tensor | None, communicator: Communicator
) -> Tensor:
    """Logarithms of probabilities (B, K, H, W) from logits that are scaled to a mean margin."""
    if margin is None:
        return logits.log_softmax(1)
    highest = logits.topk(2, dim=1).values
    gaps = highest[:, :1] - highest[:, 1:]  # (B, 1, H, W)
    weights = torch.ones_like(gaps) if confidence is None else confidence.expand_as(gaps)
    sums = torch.stack([(weights * gaps).sum((1, 2, 3)), weights.sum((1, 2, 3))])
    total, count = communicator.sum(sums).unbind()
    mean = total / count.clamp(min=FLOOR)
    factor = per_image(margin, logits, 1) / mean.clamp(min=FLOOR)
    return (factor.clamp(max=STEEPEST).reshape(-1, 1, 1, 1) * logits).log_softmax(1)


def _as_logits(values: Tensor, kind: Kind) -> Tensor:
    """Logits of at least two classes (B, K, H, W), in the working precision."""
    values = values.to(working_dtype(values))
    if kind == "probabilities":
        return values.clamp(min=FLOOR).log()
    if kind in ("mask", "trimap"):
        return torch.cat([1 - values, values], dim=1).clamp(min=FLOOR).log()
    return values if values.shape[1] > 1 else torch.cat([torch.zeros_like(values), values], dim=1)


def _as_kind(energies: Tensor, values: Tensor, kind: Kind) -> Tensor:
    """Convert logarithms of probabilities to the kind of the input ``values``."""
    if kind == "probabilities":
        return energies.exp()
    if kind == "logits":
        return energies if values.shape[1] > 1 else energies[:, 1:] - energies[:, :1]
    mask = energies[:, 1:].exp()
    return torch.where(_known(values), values.to(mask), mask) if kind == "trimap" else mask


def _known(trimap: Tensor) -> Tensor:
    """Where a trimap is background or object."""
    return (trimap <= 0) | (trimap >= 1)


def _check_input(values: Tensor, kind: Kind) -> None:
    """Raise unless the input is what its kind says."""
    check_choice(kind, "kind", KINDS, "say what the first argument is")
    check_image(values, "logits", channels=1 if kind in ("mask", "trimap") else None, empty=True)
    if kind != "logits" and not is_hidden(values):
        check_unit_range(values, "logits")
    if kind == "probabilities" and values.shape[1] < 2:
        raise ValueError(
            f"logits must have at least 2 channels as probabilities, got {values.shape[1]}; pass kind='mask'"
        )


def _checked_confidence(values: Tensor, kind: Kind, confidence: Tensor | None) -> Tensor | None:
    """Return the confidence (B or 1, 1, H, W), that of a trimap included; raise unless some pixel is trusted."""
    if confidence is not None:
        check_image(confidence, "confidence", channels=1, batch=max(len(values), 1))
        check_same_size(confidence, (values.shape[2], values.shape[3]), "confidence", "logits", values)
        check_unit_range(confidence, "confidence")
        confidence = confidence.to(working_dtype(values))
    if kind == "trimap":
        known = _known(values).to(working_dtype(values))
        confidence = known if confidence is None else known * confidence
    if confidence is None or is_hidden(confidence) or len(confidence) == 0:
        return confidence
    empty = confidence.detach().amax((1, 2, 3)) <= 0
    if bool(empty.any()):
        name = "logits" if kind == "trimap" else "confidence"
        raise ValueError(
            f"{name} must have a pixel that is {'0 or 1' if kind == 'trimap' else 'trusted'} in every image, got none "
            f"in image(s) {empty.nonzero().squeeze(1).tolist()}; mark at least one"
        )
    return confidence


def _check_guide(values: Tensor, guide: Tensor | NonlocalOperator, options: FilterOptions) -> int:
    """Raise unless the guide fits the input; return the number of images."""
    if isinstance(guide, NonlocalOperator):
        batch, size, part = len(guide.factor), guide.size, guide.factor
        bandwidths = {
            "photometric_bandwidth": options.photometric_bandwidth,
            "spatial_bandwidth": options.spatial_bandwidth,
        }
        for name, value in bandwidths.items():
            if value is not AUTO:
                raise ValueError(
                    f"{name} must be left out if guide is an operator, got {described(value)}; "
                    "pass it to nonlocal_operator"
                )
    else:
        check_image(guide, "guide", empty=True)
        batch, size, part = len(guide), (guide.shape[2], guide.shape[3]), guide
    check_same_size(values, size, "logits", "guide", part)
    if batch != len(values) and 1 not in (batch, len(values)):
        raise ValueError(
            f"logits must have batch size 1 or that of the guide, {batch}, got {len(values)}; pass one for each image"
        )
    return batch if len(values) == 1 else len(values)


def _check_options(method: MeanField, options: FilterOptions, values: Tensor, images: int) -> None:
    """Raise unless the options of the mean-field steps are valid."""
    check_count(method.steps, "steps", most=1000)
    check_values(method.strength, "strength", "not negative", images)
    if method.margin is not None:
        check_positive(method.margin, "margin", images)
    if isinstance(method.caution, str):
        check_choice(method.caution, "caution", (AUTO,), "pass it, a number or None")
    elif method.caution is not None:
        check_positive(method.caution, "caution", images)
    if isinstance(options.spatial_bandwidth, str):
        check_choice(options.spatial_bandwidth, "spatial_bandwidth", (AUTO,), "pass it, a number of pixels or None")
    if method.compatibility is not None:
        check_dtype(method.compatibility, "compatibility", "convert it with .float()")
        check_finite(method.compatibility, "compatibility")
        classes = max(values.shape[1], 2)
        if tuple(method.compatibility.shape) != (classes, classes):
            raise ValueError(
                f"compatibility must have shape ({classes}, {classes}), got {tuple(method.compatibility.shape)}; "
                "pass a row and a column for each class"
            )
