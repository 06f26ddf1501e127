"""Linear systems over the eight neighbours of each pixel, compared with dense ones."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch.filtering.neighbours import laplacian, neighbour_weights, solve_neighbours


def problem(height: int, width: int, batch: int = 2, dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
    """Guide, weights, anchors that are zero at most pixels, and values of three channels."""
    generator = torch.Generator().manual_seed(height * width)
    guide, values, anchor = (
        torch.rand(batch, channels, height, width, dtype=dtype, generator=generator) for channels in (2, 3, 1)
    )
    anchor = torch.where(anchor > 0.7, anchor, 0.0)
    anchor[..., 0, 0] = 1e4
    return guide, neighbour_weights(guide, lambda distances: torch.exp(-4 * distances)), anchor, values


def dense_laplacian(guide: Tensor) -> Tensor:
    """(N, N), pair by pair, of a guide (C, H, W)."""
    height, width = guide.shape[1:]
    matrix = torch.zeros(height * width, height * width, dtype=guide.dtype)
    for y in range(height):
        for x in range(width):
            for b in range(max(y - 1, 0), min(y + 2, height)):
                for a in range(max(x - 1, 0), min(x + 2, width)):
                    if (b, a) != (y, x):
                        weight = torch.exp(-4 * (guide[:, y, x] - guide[:, b, a]).square().sum())
                        matrix[y * width + x, b * width + a] = -weight
    return matrix - torch.diag(matrix.sum(1))


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (2, 2), (5, 8), (9, 4)])
def test_a_dense_solve_gives_the_same(size: tuple[int, int]) -> None:
    guide, weights, anchor, values = problem(*size)
    found = solve_neighbours(weights, anchor, values)
    for image in range(2):
        matrix, a, v = dense_laplacian(guide[image]), anchor[image].flatten(), values[image].flatten(1)
        torch.testing.assert_close(laplacian(weights, values)[image].flatten(1), v @ matrix)
        wanted = torch.linalg.solve(matrix + torch.diag(a), (a * v).mT).mT
        torch.testing.assert_close(found[image].flatten(1), wanted)


def test_float32_is_as_good_and_stays_so_under_autocast() -> None:
    _, weights, anchor, values = problem(40, 30)
    wanted = solve_neighbours(weights, anchor, values)
    single = [tensor.float() for tensor in (weights, anchor, values)]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = solve_neighbours(*single)
    torch.testing.assert_close(found, wanted.float(), atol=2e-5, rtol=0)
    half = solve_neighbours(weights, anchor, values.half())
    assert half.dtype == torch.float16
    torch.testing.assert_close(half.double(), wanted, atol=2e-3, rtol=0)


def test_weights_anchors_and_values_have_gradients() -> None:
    guide, _, anchor, values = problem(4, 5)

    def solved(guide: Tensor, anchor: Tensor, values: Tensor) -> Tensor:
        weights = neighbour_weights(guide, lambda distances: torch.exp(-4 * distances))
        return solve_neighbours(weights, anchor, values)

    anchor[..., 0, 0] = 2.0  # finite differences would be lost in rounding beside 1e4
    given = tuple(tensor.requires_grad_() for tensor in (guide, anchor, values))
    assert torch.autograd.gradcheck(solved, given, fast_mode=True)
    assert torch.autograd.gradgradcheck(solved, given, fast_mode=True)


def test_values_stay_within_their_range_and_constants_are_kept() -> None:
    _, weights, anchor, values = problem(20, 30)
    found = solve_neighbours(weights, anchor, values)
    assert values.min() <= found.min() < found.max() <= values.max()
    torch.testing.assert_close(solve_neighbours(weights, anchor, torch.full_like(values, 0.3)), 0 * values + 0.3)
    torch.testing.assert_close(found[..., 0, 0], values[..., 0, 0], atol=1e-3, rtol=0)


def test_pixels_that_nothing_links_keep_their_values() -> None:
    _, weights, anchor, values = problem(12, 12)
    assert torch.equal(solve_neighbours(0 * weights, 0 * anchor, values), values)
    found = solve_neighbours(0 * weights, anchor, values)
    assert torch.equal(found, values)


def test_few_steps_end_early_and_a_batch_shares_weights() -> None:
    _, weights, anchor, values = problem(30, 30)
    exact, rough = (solve_neighbours(weights, anchor, values, steps=steps) for steps in (300, 3))
    assert 1e-4 < (exact - rough).abs().max() < 0.5
    coarse = solve_neighbours(weights, anchor, values, tolerance=1e-2)
    assert 1e-6 < (exact - coarse).abs().max() < 0.1
    shared = solve_neighbours(weights[:1], anchor[:1], values)
    torch.testing.assert_close(shared[:1], exact[:1])
    torch.testing.assert_close(shared[1:], solve_neighbours(weights[:1], anchor[:1], values[1:]))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"weights": torch.ones(1, 3, 4, 5)}, r"weights must have 4 channel\(s\), got 3"),
        ({"anchor": torch.ones(1, 1, 4, 4)}, "anchor must have the height and width"),
        ({"steps": 0}, "steps must be"),
    ],
)
def test_bad_input_is_named(changed: dict[str, object], message: str) -> None:
    given = {"weights": torch.ones(1, 4, 4, 5), "anchor": torch.ones(1, 1, 4, 5), "values": torch.ones(1, 3, 4, 5)}
    with pytest.raises((TypeError, ValueError), match=message):
        solve_neighbours(**(given | changed))  # type: ignore[arg-type]
