"""Changes of brightness, and edits that make them."""

from typing import Any

import torch

from nlfilter_torch.photo import adjust_tone, enhance, sharpen
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import Balance, Limits
from nlfilter_torch.photo.picture.pixels import Fitted, part_of
from nlfilter_torch.photo.picture.viewing import within_limits

ALPHA = torch.tensor([2.2, 2.2, 2.2, 1.0])

EDITS: dict[str, Any] = {
    "detail": lambda x, **options: enhance(x, ALPHA, num_landmarks=60, **options),
    "tone": lambda x, **options: adjust_tone(x, contrast=1.5, clarity=2.0, num_landmarks=60, **options),
    "sharpen": lambda x, **options: sharpen(x, amount=8.0, num_landmarks=60, **options),
}


def drawn(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Images of 8 bits with channels at both ends of the range, and large changes of their luminance."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (2, 3, 40, 40), generator=generator).double() / 255
    image[0, 0, :9], image[1, 1, :9] = 0.0, 1.0  # no room in one direction
    return image, torch.randn(2, 1, 40, 40, generator=generator, dtype=torch.float64)


def saturated(seed: int = 0, size: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """A yellow image without blue whose last third is muted, and changes of its luminance."""
    generator = torch.Generator().manual_seed(seed)
    yellow = torch.tensor([0.95, 0.8, 0.01], dtype=torch.float64).view(1, 3, 1, 1)
    image = yellow * (0.95 + 0.1 * torch.rand(1, 3, size, size, generator=generator, dtype=torch.float64))
    muted = slice(2 * size // 3, size)
    image[..., muted] = 0.5 + 0.1 * (image[..., muted] - 0.5)
    return image, 0.15 * torch.randn(1, 1, size, size, generator=generator, dtype=torch.float64)


def changed(
    image: torch.Tensor,
    change: torch.Tensor,
    limits: Limits = "soft",
    brighter: float | Balance | None = None,
) -> torch.Tensor:
    source = InMemory(image)
    return source.all(within_limits(source, Fitted(part_of(change)), limits, brighter))
