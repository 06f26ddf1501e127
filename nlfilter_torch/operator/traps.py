"""Warnings of mistakes that give no error: wrong units, wrong order of dimensions, guides of another scale."""

from torch import Tensor

from nlfilter_torch.core.torch_internals import is_hidden
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
