"""Estimation of the noise of any source."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.nn.denoiser.estimate import measured_profile, profile_of_measured, profile_places
from nlfilter_torch.nn.denoiser.noise import Noise, measured_noise, window_places
from nlfilter_torch.nn.denoiser.profile import NoiseProfile
from nlfilter_torch.operator.options import GuideChannels
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.source import Source, at

Repaired = Callable[[Tensor, Tensor], Tensor]  # of places (n,) and their colours (B, C, n)


@torch.no_grad()
def noise_of(source: Source[M], channels: GuideChannels = "all") -> Noise:
    """Estimate the noise of any source, or of its luminance, as white noise."""
    return Noise(*source.measured(partial(_measured, channels=channels)))


@torch.no_grad()
def profile_of(source: Source[M], repaired: Repaired | None = None) -> NoiseProfile:
    """Estimate the noise of any source, some of whose colours are replaced, by scale, plane and brightness."""
    return profile_of_measured(source.measured(partial(_measured_profile, repaired=repaired)))


def _measured_profile(source: Source[M], repaired: Repaired | None) -> Tensor:
    places = profile_places(source.size)
    colours = _visible(source, places)
    if repaired is not None:
        colours = repaired(places.to(colours.device), colours)
    return measured_profile(source.size, colours)


def _visible(source: Source[M], places: Tensor) -> Tensor:
    """Colours of single pixels, 0 where they do not count: windows with much black are not measured."""
    colours, weights = at(source, places)
    return colours if weights is None else colours * (weights > 0)


def _measured(source: Source[M], channels: GuideChannels) -> Tensor:
    return measured_noise(source.size, _visible(source, window_places(source.size)), channels)
