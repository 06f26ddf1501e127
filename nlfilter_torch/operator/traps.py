"""Mistakes that give no error: wrong units, wrong order of dimensions, guides of another scale, too few landmarks.

How well landmarks cover points is measured on rows of W beside those of the exact filter, for a sample of the points.
The diagonal correction does not tell. It is large at a point that resembles no other, whose row of W is right, and in
many dimensions at most points of a cluster around a landmark, whose rows are right too, since what the correction
replaces is shared with no other point. So affinities to other points have to be computed.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import weighted
from nlfilter_torch.core.torch_internals import cached_constants, is_hidden
from nlfilter_torch.core.warning import warn

GREY_LEVELS = (4.0, 64.0)  # usual bandwidths in grey levels; where values end at 1, larger ones ask for the mean
WHITE = 1.05
COLOURS = (3, 4)  # sizes of a last dimension that holds colours
LEAST_SIDE = 16  # of an image whose channels come last
NEARLY = 1e-3  # distance of the trace of W from that of the identity, relative, and from that of the mean


def warn_of_units(guide: Tensor, bandwidth: float | Tensor | str) -> None:
    """Warn if a guide (B, C, H, W) has channels last, or in [0, 1] a bandwidth in grey levels; skipped if hidden."""
    if is_hidden(guide) or len(guide) == 0:
        return
    sides = guide.shape[1:3]
    if guide.ndim == 4 and guide.shape[3] in COLOURS and min(sides) >= LEAST_SIDE:
        warn(
            f"guide must have its channels in the second dimension, got shape {tuple(guide.shape)}; "
            "use guide.permute(0, 3, 1, 2)"
        )
    if isinstance(bandwidth, str) or (isinstance(bandwidth, Tensor) and is_hidden(bandwidth)):
        return
    least = float(bandwidth.detach().min()) if isinstance(bandwidth, Tensor) else bandwidth
    if (
        GREY_LEVELS[0] < least <= GREY_LEVELS[1]
        and guide.shape[1] in (1, 3)
        and float(guide.detach().abs().max()) <= WHITE
    ):
        warn(
            f"photometric_bandwidth must be in units of the guide, whose values end at 1, got {least:g}; "
            "divide grey levels by 255"
        )


def warn_of_scale_of_features(scaling: Tensor, guide: Tensor, bandwidth: float | Tensor | str) -> None:
    """Warn if W is nearly the identity or the mean for a guide of features, whose gradients then vanish.

    The trace of a W with a corrected diagonal is the sum of d^2, for the scaling d (B, N): N for the identity, 1 for
    the mean.
    """
    if isinstance(bandwidth, str) or guide.shape[1] in (1, 3) or len(guide) == 0 or is_hidden(scaling):
        return
    pixels = scaling.shape[1]
    if pixels < LEAST_SIDE**2:
        return
    traces = scaling.detach().square().sum(1)
    if bool((traces > (1 - NEARLY) * pixels).all()):
        warn(
            "guide must have differences near photometric_bandwidth, got so large ones that no two pixels are similar; "
            "raise photometric_bandwidth, or divide the guide by its standard deviation"
        )
    values = guide.detach().flatten(1)
    if bool((traces < 1 + NEARLY).all()) and bool((values.amax(1) > values.amin(1)).all()):
        warn(
            "guide must have differences near photometric_bandwidth, got so small ones that all pixels are alike; "
            "lower photometric_bandwidth, or divide the guide by its standard deviation"
        )


LONG = 512  # features of a pixel, above which most of the time of building an operator goes into comparing them


def warn_of_long_patches(guide: Tensor, patch_size: int) -> None:
    """Warn of patches of a feature map (B, C, ...), whose channels tell of the surroundings of a pixel already."""
    features = guide.shape[1] * patch_size ** (guide.ndim - 2)
    if patch_size > 1 and features > LONG and not is_hidden(guide):
        warn(
            f"patch_size must be 1 for guides of many channels, unless time does not matter, got {patch_size} for "
            f"{guide.shape[1]} channels: {features} numbers are compared for every pixel; pass patch_size=1, and fewer "
            "landmarks, such as 32"
        )


SAMPLED = 1024  # points whose rows are compared; all, if there are at most twice as many
FEW = 256  # points of a first look, in about 2 ms on one core
LARGEST_SHARE = 0.15  # of badly covered points, above which there is a warning
LEAST_POINTS = 1024  # below which there is none, since as many landmarks as points can be afforded
SWEEPS = 13  # of balancing the exact filter of the sample, each of which leaves a third of the deviations
GOLDEN = 0.6180339887498949  # whose multiples, without their whole parts, spread evenly over the interval from 0 to 1
HALF = 0.5  # share of its weight by which the row of a badly covered point is off


@cached_constants
def sampled_points(points: int, count: int = SAMPLED) -> Tensor:
    """Numbers (S,) of the points whose features are kept, spread over all ``points``; always the same, on the CPU."""
    if points <= 2 * count:
        return torch.arange(points)
    starts = torch.arange(count + 1) * points // count
    return starts[:-1] + (torch.arange(count).double() * GOLDEN % 1 * starts.diff()).long()


def share_above(values: Tensor, limit: float, weights: Tensor | None) -> Tensor:
    """Share (B,) of the points, by weights (B, N), whose values (B, N) are above a limit."""
    above = weighted((values > limit).double(), weights).sum(1)
    return above / (values.shape[1] if weights is None else weights.double().sum(1))


@dataclass(frozen=True, eq=False)
class SampledRows:
    """Rows of W at a sample of the points.

    Attributes:
        features: (B, D, S).
        factor: columns of U, (B, M, S).
        scaling: d, (B, S).
        remainder: r, (B, S).
        weights: number of pixels that each point represents, (B, S).
        every: number of points of the image for each of the sample.
    """

    features: Tensor
    factor: Tensor
    scaling: Tensor
    remainder: Tensor
    weights: Tensor
    every: float

    def thinned(self, count: int) -> "SampledRows":
        """The rows of about ``count`` of the points, or of all if there are fewer."""
        step = max(1, self.scaling.shape[1] // count)
        return SampledRows(
            features=self.features[..., ::step],
            factor=self.factor[..., ::step],
            scaling=self.scaling[..., ::step],
            remainder=self.remainder[..., ::step],
            weights=self.weights[..., ::step],
            every=self.every * step,
        )

    def badly_covered(self, exact: list[Tensor] | None = None) -> Tensor:
        """Share (B,) of the points, by weight, whose rows are off by more than half."""
        return share_above(self.errors(exact), HALF, self.weights)

    def errors(self, exact: list[Tensor] | None = None) -> Tensor:
        """Share (B, S) of the weight of each row that lies at other points than in the exact filter of the sample.

        Half of the sum of the differences of a row, 1 at most if no weight is negative. Of a point that stands for
        others of the image, only its own value counts as its own. The exact filters of the images are added to the list
        ``exact``, or taken from it if it is not empty.
        """
        images = range(len(self.scaling))
        exact = [] if exact is None else exact
        if not exact:
            exact += [self._exact(image) for image in images]
        return torch.stack([self._errors_of(image, exact[image]) for image in images])

    def _exact(self, image: int) -> Tensor:
        """Rows (S, S) of the exact filter of the sample of one image, in float64."""
        features, own = self.features[image].double(), self.weights[image].double()
        features = features - features.mean(1, keepdim=True)
        norms = features.square().sum(0)
        squared = norms.unsqueeze(1) + norms - 2 * features.mT @ features
        exact = torch.exp(-squared.clamp(min=0.0)) * (own * self.every)
        exact.diagonal().copy_(own)
        least = torch.finfo(exact.dtype).tiny  # row sums of points that do not count
        balanced = exact.sum(1).clamp(min=least).rsqrt()
        for _ in range(SWEEPS):
            balanced = balanced * (balanced * (exact @ balanced)).clamp(min=least).pow(-2 / 3)
        return balanced.unsqueeze(1) * exact * balanced

    def _errors_of(self, image: int, exact: Tensor) -> Tensor:
        """Errors (S,) of the rows of one image, in float64."""
        factor, scaling, own = (part[image].double() for part in (self.factor, self.scaling, self.weights))
        rows = scaling.unsqueeze(1) * (factor.mT @ factor) * scaling
        itself = rows.diagonal() * own + self.remainder[image]
        rows = rows * (own * self.every)
        rows.diagonal().copy_(itself)
        return ((rows - exact).abs().sum(1) / 2).nan_to_num(nan=torch.inf)
