"""Labels of a few points extended to all points, by solving with W.

After Zhou, Bousquet, Lal, Weston and Schoelkopf, "Learning with Local and Global Consistency", 2004.
"""

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_instance, check_positive, check_shape, check_tensor
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.filtering.prior import proximal_map
from nlfilter_torch.operator.operator import NonlocalOperator

NO_LABEL = -1  # label of points whose class is to be found
LABEL_STRENGTH = 100.0


@full_precision
def propagate_labels(operator: NonlocalOperator, labels: Tensor, *, strength: float = LABEL_STRENGTH) -> Tensor:
    """Extend the labels of some points to all points that W links to them.

    The scores are ``(I + g (I - W))^-1 Y`` with the indicators Y of the labels, solved exactly, and divided by their
    sum. W links points within a bandwidth in all features: in many dimensions, where the nearest neighbours of a point
    are hardly nearer than others, it says less than a graph of nearest neighbours.

    Args:
        operator: W of the points.
        labels: (B, N) or (1, N), integers: classes from 0 on, and -1 where the class is unknown.
        strength: g, positive: how far labels extend; at 0 they would stay at their points.

    Returns:
        (B, K, N) in the operator's dtype, probabilities that add up to 1 over the K classes; equal ones for points that
        no labelled point reaches. Differentiable in the operator.

    Raises:
        TypeError, ValueError: if ``labels`` are no integers of that shape, or less than -1, or all unknown, or
            ``strength`` is not positive.

    Example:
        >>> from nlfilter_torch import operator_from_features
        >>> generator = torch.Generator().manual_seed(0)
        >>> points = torch.randn(1, 2, 200, generator=generator)
        >>> points[..., 100:] += 6
        >>> operator = operator_from_features(points, size=(200,), num_landmarks=20)
        >>> labels = torch.full((1, 200), -1)
        >>> labels[0, 0], labels[0, 150] = 0, 1
        >>> found = propagate_labels(operator, labels).argmax(1)
        >>> int((found[0, :100] == 0).sum()), int((found[0, 100:] == 1).sum())
        (100, 100)
    """
    check_instance(operator, NonlocalOperator, "operator", "make it with operator_from_features")
    check_tensor(labels, "labels")
    check_positive(strength, "strength")
    if labels.dtype.is_floating_point or labels.dtype.is_complex or labels.dtype == torch.bool:
        raise TypeError(f"labels must be integers, got {labels.dtype}; number the classes from 0, -1 elsewhere")
    if labels.ndim != 2 or len(labels) not in (1, len(operator)):
        raise ValueError(
            f"labels must have shape (1, N) or ({len(operator)}, N), got {tuple(labels.shape)}; use labels[None]"
        )
    check_shape(labels, (len(labels), operator.factor.shape[2]), "labels", "give one for each point")
    if int(labels.min()) < NO_LABEL or int(labels.max()) < 0:
        raise ValueError(
            f"labels must be -1 or classes from 0 on, and some known, got {int(labels.min())} to {int(labels.max())}; "
            "number the classes from 0"
        )
    classes = torch.arange(int(labels.max()) + 1, device=labels.device)
    known = (labels.unsqueeze(1) == classes.view(1, -1, 1)).to(operator.factor)
    return shares(proximal_map(operator, known.expand(len(operator), -1, -1), strength, "red", []))


def shares(scores: Tensor) -> Tensor:
    """Scores (B, K, N) as probabilities; approximate affinities may be slightly negative."""
    scores = scores.clamp(min=0)
    total = scores.sum(1, keepdim=True)
    least = torch.finfo(scores.dtype).tiny
    return torch.where(total > least, scores / total.clamp(min=least), 1 / scores.shape[1])
