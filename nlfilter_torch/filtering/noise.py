"""The strength of noise as functions take it: a number, a map, or a model that draws it."""

import math
from typing import Protocol, TypeGuard, runtime_checkable

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size, check_values
from nlfilter_torch.core.precision import per_image


@runtime_checkable
class NoiseModel(Protocol):
    """Noise that is not independent from pixel to pixel, such as a :class:`~nlfilter_torch.NoiseProfile`."""

    def variance(self, image: Tensor) -> Tensor:
        """Variance (B, 1, H, W) of the noise of each channel of an image (B, C, H, W)."""

    def draw(self, image: Tensor, generator: torch.Generator) -> Tensor:
        """A random field (B, C, H, W) with the covariance of the noise of an image (B, C, H, W)."""


def is_noise_map(noise: object, size: tuple[int, ...]) -> TypeGuard[Tensor]:
    """Whether this is a map for an image (H, W) or a volume, and not a level for each image, (B, 1, 1, 1)."""
    return (
        isinstance(noise, Tensor)
        and noise.ndim == 2 + len(size)
        and (noise.numel() != len(noise) or math.prod(size) == 1)
    )


def noise_map(noise: float | Tensor, image: Tensor, name: str = "noise") -> Tensor:
    """Expand noise levels, a number, (B,) or a map (B, 1 or C, H, W), to a map; errors call them ``name``."""
    size = tuple(image.shape[2:])
    if is_noise_map(noise, size):
        check_image(noise, name, batch=image.shape[0], dimensions=(image.ndim,))
        check_same_size(noise, size, name, "image")
        if noise.shape[1] not in (1, image.shape[1]):
            raise ValueError(
                f"{name} must have 1 channel or as many as the image, {image.shape[1]}, got {noise.shape[1]}; select 1"
            )
        check_values(noise.flatten(), name, "not negative", noise.numel())
        return noise.to(image).expand(image.shape[0], *noise.shape[1:])
    check_values(noise, name, "not negative", image.shape[0])
    return per_image(noise, image, image.ndim).expand(image.shape[0], 1, *size)


def variance_of(noise: float | Tensor | NoiseModel, image: Tensor) -> Tensor:
    """Variance (B, 1 or C, H, W) of the noise of an image, without a gradient; of levels in float64."""
    if isinstance(noise, NoiseModel):
        return noise.variance(image.detach())
    return noise_map(noise, image).detach().double().square()


def drawn(noise: float | Tensor | NoiseModel, image: Tensor, generator: torch.Generator) -> Tensor:
    """A random field (B, C, H, W) with the covariance of the noise of an image: random signs where it is white.

    Signs estimate traces with the least variance (Hutchinson, 1990): they add no error on the diagonal. Coarse noise
    has few independent values, and the power of a field deviates: it is set to that of the noise.
    """
    if isinstance(noise, NoiseModel):
        field = noise.draw(image.detach(), generator)
        wanted, power = (
            values.double().flatten(1).mean(1) for values in (noise.variance(image.detach()), field.double().square())
        )
        return field * per_image(torch.where(power > 0, wanted / power, 0.0).sqrt(), field, field.ndim)
    return noise_map(noise, image).detach() * random_signs(tuple(image.shape), image, generator)


def sampled(noise: float | Tensor | NoiseModel, image: Tensor, generator: torch.Generator) -> Tensor:
    """Normal noise (B, C, H, W) for an image, where :func:`drawn` may be random signs."""
    if isinstance(noise, NoiseModel):
        return noise.draw(image.detach(), generator)
    return noise_map(noise, image).detach() * random_normal(tuple(image.shape), image, generator)


def random_normal(shape: tuple[int, ...], like: Tensor, generator: torch.Generator) -> Tensor:
    """Standard normal numbers, equal for a generator whatever the device of ``like``."""
    return torch.randn(shape, generator=generator, device=generator.device).to(like.device, like.dtype)


def random_signs(shape: tuple[int, ...], like: Tensor, generator: torch.Generator) -> Tensor:
    """Random numbers of 1 and -1, equal for a generator whatever the device of ``like``."""
    bits = torch.randint(2, shape, generator=generator, device=generator.device)
    return 2 * bits.to(like.device, like.dtype) - 1
