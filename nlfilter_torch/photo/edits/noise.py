"""Estimation of the noise of any source."""

from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.nn.denoiser.noise import Noise, measured_noise, window_places
from nlfilter_torch.operator.options import GuideChannels
from nlfilter_torch.photo.picture.drawn import M
from nlfilter_torch.photo.picture.source import Source


@torch.no_grad()
def noise_of(source: Source[M], channels: GuideChannels = "all") -> Noise:
    """Estimate the noise of any source, or of its luminance."""
    return Noise(*source.measured(partial(_measured, channels=channels)))


def _measured(source: Source[M], channels: GuideChannels) -> Tensor:
    return measured_noise(source.size, source.colours(window_places(source.size)), channels)
