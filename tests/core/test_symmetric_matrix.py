"""Functions of symmetric matrices have the derivative of their divided differences."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    nonlocal_operator,
)
from nlfilter_torch.core.symmetric_matrix import SymmetricMatrix
from tests.images import hard_images
from tests.problems import noise, seeded


def weighted(tensor: Tensor, seed: int = 9) -> Tensor:
    """A sum with a different weight for every entry."""
    return (tensor * torch.randn(tensor.shape, generator=seeded(seed), dtype=tensor.dtype)).sum()


def degenerate_guides() -> dict[str, Tensor]:
    """Images whose filter has repeated eigenvalues, by symmetry or for lack of different pixels."""
    half = noise(1, 1, 8, 5, seed=5)
    images = {name: torch.from_numpy(hard_images()[name][:8, 18:28].copy()) for name in ("constant", "checkerboard")}
    images["two colours"] = torch.from_numpy(hard_images()["two colours"][:8, 19:29].copy())
    guides = {name: image[None, None] for name, image in images.items()}
    guides["mirrored"] = torch.cat([half, half.flip(-1)], dim=3)
    # There are only four different patches, so that some of the eight landmarks coincide.
    guides["duplicated landmarks"] = noise(1, 1, 2, 2, seed=6).repeat(1, 1, 4, 5)
    return guides


GUIDES = degenerate_guides()


def directional(
    function: Callable[[Tensor], Tensor], at: Tensor, directions: list[Tensor], step: float = 1e-5
) -> tuple[Tensor, Tensor]:
    """Return directional derivatives by backward and by central differences of fourth order."""
    at = at.detach().requires_grad_()
    gradient = torch.autograd.grad(function(at), at)[0]
    result, expected = [], []
    with torch.no_grad():
        for direction in directions:
            f = {k: function(at + k * step * direction) for k in (-2, -1, 1, 2)}
            result.append((gradient * direction).sum())
            expected.append((8 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12 * step))
    return torch.stack(result), torch.stack(expected)


@pytest.mark.parametrize(
    "response",
    [lambda s: s**0.1, torch.sqrt, lambda s: s**3, torch.exp, torch.rsqrt, lambda s: torch.sin(20 * s)],
    ids=["power 0.1", "root", "cube", "exp", "rsqrt", "sine"],
)
def test_divided_differences_are_finite_differences(response: Callable[[Tensor], Tensor]) -> None:
    for name in GUIDES:
        spectrum = nonlocal_operator(
            GUIDES[name], landmarks="uniform", num_landmarks=8, photometric_bandwidth=0.3
        ).spectrum()
        # Shifted into [0.1, 1.1], where even the root has differences on both sides; repeated eigenvalues stay so.
        matrix = spectrum.ritz.matrix + 0.1 * torch.eye(8, dtype=torch.float64)
        eigenvalues = torch.linalg.eigvalsh(matrix)[0]
        if name != "mirrored":
            assert (eigenvalues.diff() < 1e-6).any(), "nothing meets"

        def function(root: Tensor) -> Tensor:
            symmetric = SymmetricMatrix.of((root + root.mT) / 2)
            return weighted(symmetric.apply(response, torch.ones_like(symmetric.eigenvalues).bool()))

        directions = [torch.randn(matrix.shape, generator=seeded(seed), dtype=matrix.dtype) for seed in range(5)]
        result, expected = directional(function, matrix, directions)
        torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-7 * expected.abs().max().item())
