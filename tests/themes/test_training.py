"""Robust training: the loss decreases for any seed, and hundreds of steps on difficult crops give no NaN."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import pytest
import torch
from torch import Tensor, nn

from nlfilter_torch import NonlocalFilter
from tests.images import photograph
from tests.problems import seeded

NOISE = 25 / 255
EVERYTHING = ("alpha", "residual", "photometric_bandwidth", "spatial_bandwidth", "patch_weights")


class Denoiser(nn.Module):
    """A small convolution that computes the guide, and a filter with all parameters learned."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.guide = nn.Conv2d(1, 6, 5, padding=2)
        self.filter = NonlocalFilter(
            (0.5, 0.8, 1.0),
            learn=EVERYTHING,
            patch_size=3,
            photometric_bandwidth=0.3,
            spatial_bandwidth=10.0,
            num_landmarks=16,
        )

    def forward(self, noisy: Tensor) -> Tensor:
        filtered: Tensor = self.filter(noisy, self.guide(noisy))
        return filtered


def crops(names: tuple[str, ...], side: int, generator: torch.Generator) -> Iterator[Tensor]:
    """An endless sequence of random crops (2, 1, side, side) of photographs."""
    pictures = [torch.from_numpy(photograph(name).copy()).float() for name in names]
    while True:
        batch = []
        for _ in range(2):
            picture = pictures[int(torch.randint(len(pictures), (), generator=generator))]
            top, left = (int(torch.randint(n - side + 1, (), generator=generator)) for n in picture.shape)
            batch.append(picture[top : top + side, left : left + side])
        yield torch.stack(batch).unsqueeze(1)


@pytest.mark.parametrize("seed", range(5))
def test_loss_falls_on_every_seed(seed: int) -> None:
    generator = seeded(seed)
    model = Denoiser(seed)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.02)
    clean = torch.cat([batch for batch, _ in zip(crops(("camera", "coins"), 32, generator), range(3), strict=False)])
    noisy = clean + NOISE * torch.randn(clean.shape, generator=generator)
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        loss = (model(noisy) - clean).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-5:]) / 5 < 0.8 * losses[0]
    assert losses[-1] < 0.6 * NOISE**2  # it also removes noise


@contextmanager
def random_bandwidths(layer: NonlocalFilter, generator: torch.Generator) -> Iterator[None]:
    """Set bandwidths to between a hundredth and a hundred times their learned values."""
    logarithms = [layer.affinity.log_photometric_bandwidth, layer.affinity.log_spatial_bandwidth]
    learned = [p.detach().clone() for p in logarithms]
    for p in logarithms:
        p.data += 2 * (2 * torch.rand((), generator=generator) - 1) * math.log(10)
    yield
    for p, value in zip(logarithms, learned, strict=True):
        p.data.copy_(value)


def clean_and_noisy(step: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A pair of random size; every fifth is black, grey or white, every second of these without noise."""
    side = int(torch.randint(9, 25, (), generator=generator))
    clean = next(crops(("camera", "coins", "moon", "rocket"), side, generator))
    if step % 5 == 0:
        clean = torch.full_like(clean, int(torch.randint(3, (), generator=generator)) / 2)
    strength = 0.0 if step % 10 == 0 else NOISE * torch.rand((), generator=generator)
    return clean, clean + strength * torch.randn(clean.shape, generator=generator)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:guide must have differences near:UserWarning")  # of bandwidths tried on purpose
def test_hundreds_of_steps_without_a_nan() -> None:
    generator = seeded(0)
    model = Denoiser(0)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.01)
    for step in range(300):
        clean, noisy = clean_and_noisy(step, generator)
        with random_bandwidths(model.filter, generator) if step % 3 == 0 else nullcontext():
            optimizer.zero_grad()
            filtered = model(noisy)
            assert filtered.isfinite().all(), step
            (filtered - clean).square().mean().backward()
        for name, parameter in model.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), (step, name)
        # Tiny bandwidths give gradients of any size; they only have to be finite.
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    assert all(p.isfinite().all() for p in model.parameters())
