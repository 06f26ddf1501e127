"""Interpolation in lattices of colours: the kernel in C, and what is left to the definition in torch."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.kernels import library
from nlfilter_torch.core.kernels.lattice import MOST, corners, interpolate
from tests.native import by_torch, needs_kernels, random


def colours(batch: int, pixels: int) -> Tensor:
    """Colours (B, 3, P), some outside [0, 1], some at nodes and some grey."""
    values = 0.5 + 0.4 * random(batch, 3, pixels)
    values[:, :, ::5] = (16 * values[:, :, ::5]).round() / 16
    values[:, :, ::7] = values[:, :1, ::7]
    return values


def exact(values: Tensor, lattice: Tensor) -> Tensor:
    """The definition in float64."""
    return by_torch(interpolate, values.double(), lattice.double())


@pytest.mark.parametrize(
    ("nodes", "batch", "lattices", "pixels"),
    [(2, 2, 2, 67), (2, 1, 1, 40_001), (9, 3, 1, 1237), (17, 1, 1, 1), (33, 2, 2, 67), (33, 1, 1, 40_001)],
)
def test_interpolation(level: int, nodes: int, batch: int, lattices: int, pixels: int) -> None:
    values, lattice = colours(batch, pixels), random(lattices, 3, nodes, nodes, nodes, seed=1)
    result = interpolate(values, lattice)
    torch.testing.assert_close(result, by_torch(interpolate, values, lattice), atol=1e-6, rtol=1e-6)
    # Rounded places of nodes change results by at most the rounding times the differences of neighbours.
    torch.testing.assert_close(result.double(), exact(values, lattice), atol=1e-6 * nodes, rtol=0)
    double = interpolate(values.double(), lattice.double())
    assert torch.equal(double, exact(values, lattice))


@pytest.mark.parametrize("nodes", [2, 5, 17])
def test_greys_depend_on_the_two_nearest_grey_nodes_alone(level: int, nodes: int) -> None:
    greys = torch.linspace(-0.5, 1.5, 301).expand(1, 3, -1)
    lattice = random(1, 3, nodes, nodes, nodes) * 1e6
    ramp = torch.linspace(0, 1, nodes)
    lattice[:, :, range(nodes), range(nodes), range(nodes)] = ramp
    result = interpolate(greys, lattice)
    torch.testing.assert_close(result, greys.clamp(0, 1), atol=2e-7, rtol=0)
    assert bool((result.diff() >= -1e-7).all())


def test_values_at_nodes_are_exact(level: int) -> None:
    lattice = random(1, 3, 9, 9, 9)
    steps = torch.arange(9) / 8
    nodes = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij")).flatten(1)[None]
    assert torch.equal(interpolate(nodes, lattice), lattice.flatten(2))
    assert torch.equal(interpolate(nodes * 3 - 1, lattice)[..., -1], lattice[:, :, -1, -1, -1])


def test_colours_that_are_no_numbers_stay_with_their_pixel(level: int) -> None:
    values, lattice = colours(1, 100), random(1, 3, 9, 9, 9)
    wanted = interpolate(values, lattice)
    changed = values.clone()
    changed[0, 0, 3], changed[0, 1, 40], changed[0, 2, 99] = torch.nan, torch.nan, torch.nan
    result = interpolate(changed, lattice)
    kept = torch.ones(100, dtype=torch.bool)
    kept[[3, 40, 99]] = False
    assert torch.equal(result[..., kept], wanted[..., kept])
    assert bool(result[..., ~kept].isnan().all())
    torch.testing.assert_close(by_torch(interpolate, changed, lattice), result, equal_nan=True)
    infinite = values.masked_fill(values > 0.9, torch.inf).masked_fill(values < 0.1, -torch.inf)
    limited = values.masked_fill(values > 0.9, 1.0).masked_fill(values < 0.1, 0.0)
    assert torch.equal(interpolate(infinite, lattice), interpolate(limited, lattice))


def test_colours_of_any_layout_and_number_of_threads(level: int, threads: Callable[[int], None]) -> None:
    lattice = random(2, 3, 5, 5, 5)
    values = colours(2, 50_003)
    threads(1)
    wanted = interpolate(values, lattice)
    assert torch.equal(interpolate(values.mT.contiguous().mT, lattice), wanted)
    assert torch.equal(interpolate(values[..., 1:], lattice), wanted[..., 1:])
    assert torch.equal(interpolate(values[:, :1].expand(-1, 3, -1), lattice)[:, 0, ::7], wanted[:, 0, ::7])
    assert torch.equal(interpolate(values, lattice.mT.contiguous().mT), wanted)
    threads(3)
    assert torch.equal(interpolate(values, lattice), wanted)


def test_without_colours_there_is_nothing() -> None:
    lattice = random(1, 3, 3, 3, 3)
    assert interpolate(torch.zeros(0, 3, 5), lattice).shape == (0, 3, 5)
    assert interpolate(torch.zeros(2, 3, 0), lattice).shape == (2, 3, 0)


@needs_kernels
def test_lattices_of_too_many_nodes_are_left_to_the_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    values, lattice = colours(1, 20), torch.zeros(1, 3, 1, 1, 1).expand(-1, -1, *(3 * [MOST + 1]))
    monkeypatch.setattr(library, "_library", None)  # a kernel cannot be called
    assert torch.equal(interpolate(values, lattice), torch.zeros(1, 3, 20))
    with pytest.raises(AttributeError):
        interpolate(values, lattice[..., :MOST, :MOST, :MOST])


def test_derivatives_are_those_of_the_definition() -> None:
    values = colours(2, 9).double().requires_grad_()
    lattice = random(2, 3, 3, 3, 3).double().requires_grad_()
    assert torch.autograd.gradcheck(interpolate, (values.detach() + 1e-3, lattice))
    mapped = torch.vmap(lambda each: interpolate(each[None], lattice[:1])[0])(values)
    torch.testing.assert_close(mapped, interpolate(values, lattice[:1]))
    single = values.detach().float().requires_grad_()
    interpolate(single, lattice.detach().float()).square().sum().backward()
    interpolate(values, lattice).square().sum().backward()
    assert single.grad is not None
    assert values.grad is not None
    torch.testing.assert_close(single.grad.double(), values.grad, atol=1e-4, rtol=1e-4)


def test_weights_of_corners_add_up_to_one() -> None:
    places, weights = corners(colours(2, 500), 9)
    torch.testing.assert_close(weights.sum(1), torch.ones(2, 500))
    assert bool((weights >= 0).all())
    assert 0 <= int(places.min()) <= int(places.max()) < 9**3
