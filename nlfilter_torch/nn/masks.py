"""Layers that compute masks from a spectrum and regions."""

from collections.abc import Collection
from types import MappingProxyType
from typing import Literal

from torch import Tensor

from nlfilter_torch.core.checks import check_values
from nlfilter_torch.filtering.masks import diffusion_mask, segment_mask
from nlfilter_torch.nn.parameters import Learnable, check_learn, positive_option
from nlfilter_torch.operator.spectrum import Spectrum

DiffusionOption = Literal["time", "width"]
SegmentOption = Literal["time", "temperature"]


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

    def __init__(
        self, *, time: float = 1.0, width: float = 4.0, learn: DiffusionOption | Collection[DiffusionOption] = ()
    ) -> None:
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


class SegmentMask(Learnable):
    """Layer that partitions an image from a spectrum and regions by :func:`segment_mask`.

    Args:
        time: diffusion time t > 0.
        temperature: 0 for a hard partition; a positive number for a soft one, with a gradient.
        learn: the options to learn: any of ``"time"`` and ``"temperature"``; both stay positive.

    Raises:
        TypeError, ValueError: if ``time`` is not positive, ``temperature`` is negative, or 0 where something is
            learned, or ``learn`` has any other name.
    """

    learnable = MappingProxyType({"time": "log_time", "temperature": "log_temperature"})
    time: float | Tensor = positive_option("time", "Number; a tensor of shape () if it is learned.")
    temperature: float | Tensor = positive_option("temperature", "Number; a tensor of shape () if it is learned.")

    def __init__(
        self,
        *,
        time: float = 1.0,
        temperature: float = 0.0,
        learn: SegmentOption | Collection[SegmentOption] = (),
    ) -> None:
        super().__init__()
        names = check_learn(learn, tuple(self.learnable))
        check_values(temperature, "temperature", "not negative")
        if names and temperature == 0:
            raise ValueError(
                "temperature must be positive to learn it or the time, as a hard partition has no gradient, got 0; "
                "start with 1.0"
            )
        self.start_positive("time", time, names)
        self.start_positive("temperature", temperature, names, other=None if temperature else type(temperature))

    def forward(self, spectrum: Spectrum, regions: Tensor) -> Tensor:
        """Compute a partition (B, K, H, W), of zeros and ones at temperature 0, from regions (B, K, H, W)."""
        return segment_mask(spectrum, regions, time=self.time, temperature=self.temperature)

    def extra_repr(self) -> str:
        """Time and temperature."""
        return f"time={self.shown('time')}, temperature={self.shown('temperature')}"
