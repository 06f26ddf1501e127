"""Layers that compute masks from a spectrum and regions."""

from collections.abc import Collection
from types import MappingProxyType

from torch import Tensor, nn

from nlfilter_torch.core.checks import check_positive
from nlfilter_torch.filtering.masks import diffusion_mask, segment_mask
from nlfilter_torch.nn.parameters import Learnable, check_learn, positive_option
from nlfilter_torch.operator.spectrum import Spectrum


class DiffusionMask(Learnable):
    """Layer that computes masks from a spectrum and regions by :func:`diffusion_mask`.

    Args:
        time: diffusion time t > 0.
        width: squared diffusion distance at which the mask has fallen to 1/e.
        learn: the options to learn: any of ``"time"`` and ``"width"``; both stay positive.

    Raises:
        TypeError, ValueError: if ``time`` or ``width`` is not positive, or ``learn`` has any other name.
    """

    learnable = MappingProxyType({"time": "log_time", "width": "log_width"})
    time: float | Tensor = positive_option("time", "Number; a tensor of shape () if it is learned.")
    width: float | Tensor = positive_option("width", "Number; a tensor of shape () if it is learned.")

    def __init__(self, *, time: float = 1.0, width: float = 4.0, learn: Collection[str] = ()) -> None:
        super().__init__()
        names = check_learn(learn, tuple(self.learnable))
        self.start_positive("time", time, names)
        self.start_positive("width", width, names)

    def forward(self, spectrum: Spectrum, region: Tensor, negative: Tensor | None = None) -> Tensor:
        """Compute masks (B, K, H, W) in (0, 1] of regions (B, K, H, W) that avoid the regions ``negative``."""
        return diffusion_mask(spectrum, region, time=self.time, width=self.width, negative=negative)

    def extra_repr(self) -> str:
        """Time and width."""
        return f"time={self.shown('time')}, width={self.shown('width')}"


class SegmentMask(nn.Module):
    """Layer that partitions an image from a spectrum and regions by :func:`segment_mask`.

    Args:
        time: diffusion time t > 0.

    Raises:
        TypeError, ValueError: if ``time`` is not positive.
    """

    def __init__(self, *, time: float = 1.0) -> None:
        super().__init__()
        check_positive(time, "time")
        self.time = time

    def forward(self, spectrum: Spectrum, regions: Tensor) -> Tensor:
        """Compute a partition (B, K, H, W) of zeros and ones from regions (B, K, H, W)."""
        return segment_mask(spectrum, regions, time=self.time)

    def extra_repr(self) -> str:
        """Time."""
        return f"time={self.time}"
