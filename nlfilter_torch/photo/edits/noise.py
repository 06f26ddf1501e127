"""Estimation of the noise of any source."""

from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.nn.denoiser.estimate import measured_profile, profile_of_measured, profile_places
from nlfilter_torch.nn.denoiser.noise import Noise, measured_noise, window_places
from nlfilter_torch.nn.denoiser.profile import NoiseProfile
from nlfilter_torch.operator.options import GuideChannels
from nlfilter_torch.photo.picture.drawn import M
from nlfilter_torch.photo.picture.source import Source


@torch.no_grad()
def noise_of(source: Source[M], channels: GuideChannels = "all") -> Noise:
    """Estimate the noise of any source, or of its luminance, as white noise."""
    return Noise(*source.measured(partial(_measured, channels=channels)))


@torch.no_grad()
def profile_of(source: Source[M]) -> NoiseProfile:
    """Estimate the noise of any source by scale, plane and brightness."""
    return profile_of_measured(source.measured(_measured_profile))


def _measured_profile(source: Source[M]) -> Tensor:
    return measured_profile(source.size, source.colours(profile_places(source.size)))


def _measured(source: Source[M], channels: GuideChannels) -> Tensor:
    return measured_noise(source.size, source.colours(window_places(source.size)), channels)
