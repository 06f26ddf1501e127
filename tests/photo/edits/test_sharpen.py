"""Sharpening: edges, noise, and amounts."""

import torch

from nlfilter_torch.photo import sharpen
from tests.problems import colour, luminance, noise


def test_sharpening_raises_edges_and_spares_noise() -> None:
    clean = luminance(colour("astronaut", 96, 96))
    noisy = clean + 10 / 255 * torch.randn(2, 1, 96, 96, generator=torch.Generator().manual_seed(0))
    sharp = sharpen(noisy, amount=5.0)
    direction = torch.stack([clean.diff(dim=3)[..., :-1, :], clean.diff(dim=2)[..., :-1]])
    strength = direction.norm(dim=0)
    strong = strength > strength.quantile(0.95)

    def slope(image: torch.Tensor) -> torch.Tensor:
        mean = image.mean(0, keepdim=True)
        gradient = torch.stack([mean.diff(dim=3)[..., :-1, :], mean.diff(dim=2)[..., :-1]])
        return ((gradient * direction).sum(0) / strength)[strong].mean()

    wall = (slice(None), slice(None), slice(2, 18), slice(58, 70))
    assert slope(sharp) > 1.2 * slope(noisy)
    assert (sharp[0] - sharp[1])[wall[1:]].std() < 1.2 * (noisy[0] - noisy[1])[wall[1:]].std()
    assert torch.equal(sharpen(clean, amount=1.0), clean)
    assert not torch.equal(sharpen(noisy), sharpen(noisy, guide_blur=0.0))
    gains = [slope(sharpen(clean, amount=amount)) / slope(clean) for amount in (2.0, 4.0, 8.0)]
    assert gains == sorted(gains)
    assert 1.2 < gains[1] < 1.6
    shading = torch.linspace(0.2, 0.8, 96).expand(1, 1, 96, 96)
    torch.testing.assert_close(sharpen(shading, amount=8.0), shading, atol=0.5 / 255, rtol=0)


def test_the_amount_of_sharpening_is_not_rounded_to_float32() -> None:
    exact = torch.tensor(3.3, dtype=torch.float64)
    options = {"limits": "none", "num_landmarks": 20}
    image = 0.2 + 0.6 * noise(2, 3, 20, 22, dtype=torch.float32).double()
    close, far = (sharpen(image, amount=amount, **options) for amount in (3.3, exact.float().double()))
    assert torch.equal(sharpen(image, amount=exact, **options), close)
    assert not torch.equal(close, far)
