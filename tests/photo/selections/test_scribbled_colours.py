"""Colours of scribbles: densities, evenness, links by even areas, and the points that are compared."""

import heapq
from collections.abc import Callable, Iterator

import pytest
import torch

from nlfilter_torch.core.blocks import CACHED
from nlfilter_torch.photo.selections import scribbled_colours
from nlfilter_torch.photo.selections.scribbled_colours import (
    density,
    evenness,
    every_nth,
    linked_evenly,
    trimap_share,
)
from tests.problems import noise


def test_densities_are_sums_of_gaussians() -> None:
    places, points = noise(2, 3, 1, 700).squeeze(2), noise(2, 3, 1, 5, seed=1).squeeze(2)
    weights = torch.tensor([[[1.0, 0.0, 0.5, 2.0, 0.0]], [[0.0] * 5]], dtype=torch.float64)
    sums = density(places, points, weights, torch.full((1, 1, 1), 0.3, dtype=torch.float64))
    squares = (places[:, :, :, None] - points[:, :, None]).square().mean(1)
    wanted = (torch.exp(-squares[0] / 0.09) * weights[0]).sum(1)
    torch.testing.assert_close(sums[0, 0], wanted, atol=1e-12, rtol=0)
    assert (sums[1] == 0).all()  # without weights there is nothing


def test_evenness() -> None:
    flat = torch.full((1, 3, 40, 40), 0.4, dtype=torch.float64)
    assert evenness(flat).min() > 0.99
    slope = flat + 0.002 * torch.arange(40).double()  # half a grey level per pixel
    assert evenness(slope)[..., 8:32].min() > 0.5
    assert evenness(flat + 0.3 * noise(1, 1, 40, 40)).max() < 0.1


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (112, 160), (300, 430), (1, 200_000), (70_000, 3)])
def test_points_inside_are_few_and_spread_evenly(size: tuple[int, int]) -> None:
    places = scribbled_colours.inner_places(size)
    assert 1 <= len(places) <= 64 * 16
    assert torch.equal(places, places.unique())
    rows, columns = places // size[1], places % size[1]
    for numbers, length in ((rows, size[0]), (columns, size[1])):
        lines = numbers.unique()
        gaps = torch.cat([lines[:1], lines.diff(), length - lines[-1:]])
        assert gaps.max() <= max(1, min(size) // 16, -(-max(size) // 64))


def best_path(even: torch.Tensor, starts: torch.Tensor) -> torch.Tensor:
    """Least evenness along the best path from the starts to every pixel, (H, W), by Dijkstra's algorithm."""
    widest = torch.zeros_like(even)
    queue = [(-float(even[tuple(place)]), *place) for place in starts.nonzero().tolist()]
    heapq.heapify(queue)
    while queue:
        value, row, column = heapq.heappop(queue)
        if -value <= float(widest[row, column]):
            continue
        widest[row, column] = -value
        for y, x in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if 0 <= y < even.shape[0] and 0 <= x < even.shape[1]:
                heapq.heappush(queue, (max(value, -float(even[y, x])), y, x))
    return widest


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (12, 1), (17, 23)])
def test_links_follow_the_best_path(monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]) -> None:
    monkeypatch.setattr(scribbled_colours, "LINK_STEP", 1)
    even = noise(2, 1, *size)
    scribbles = (noise(2, 2, *size, seed=1) > 0.9).double() * 0.3
    linked = linked_evenly(even, scribbles)
    for k in range(2):
        front, back = (best_path(even[k, 0], scribbles[k, side] > 0) for side in (0, 1))
        expected = ((front - back - 0.25) / 0.25).clamp(0, 1)
        torch.testing.assert_close(linked[k, 0], expected)


def test_links_pass_no_border_narrower_than_the_search() -> None:
    image = torch.full((1, 3, 60, 90), 0.6).double()
    image[..., 40] = 0.2  # a line of one pixel, such as a mast
    scribble = torch.zeros(1, 2, 60, 90).double()
    scribble[:, 0, 20:30, 5:15] = 1
    linked = linked_evenly(evenness(image), scribble)
    assert linked[..., :30].min() == 1
    assert linked[..., 50:].max() == 0


def test_pixels_to_compare_do_not_depend_on_other_images() -> None:
    colours = noise(2, 3, 1, 50).squeeze(2)
    weights = torch.zeros(2, 1, 50, dtype=torch.float64)
    weights[0, :, ::2], weights[1, :, 7:40] = 1.0, 0.5
    together, kept = every_nth(colours, weights, 8)
    for k in range(2):
        alone, own = every_nth(colours[k : k + 1], weights[k : k + 1], 8)
        assert 8 <= own.shape[2] <= 16
        assert torch.equal(together[k][:, kept[k, 0] > 0], alone[0])
        assert torch.equal(kept[k][kept[k] > 0], own[0, 0])


@pytest.mark.parametrize(("count", "lengths"), [(4 * CACHED + 8, [CACHED] * 4 + [8]), (CACHED, [CACHED])])
def test_each_worker_sums_densities_over_blocks_of_its_own(
    monkeypatch: pytest.MonkeyPatch, count: int, lengths: list[int]
) -> None:
    places, points, weights = noise(1, 3, count), noise(1, 3, 5, seed=1), noise(1, 2, 5, seed=2)
    bandwidth = torch.full((1, 1, 1), 0.3, dtype=torch.float64)
    alone = density(places, points, weights, bandwidth)
    shared = list[list[slice]]()

    def record(part: Callable[[slice], torch.Tensor], blocks: list[slice], workers: int) -> Iterator[torch.Tensor]:
        assert workers == min(16, len(blocks))
        shared.append(blocks)
        return map(part, blocks)

    monkeypatch.setattr(scribbled_colours, "threads_for", lambda *_: 16)
    monkeypatch.setattr("nlfilter_torch.core.blocks.cores", lambda: 16)
    monkeypatch.setattr("nlfilter_torch.core.workers.in_order", record)
    torch.testing.assert_close(density(places, points, weights, bandwidth), alone)
    if len(lengths) == 1:
        assert shared == []  # no threads are started for a single block
    else:
        assert [block.stop - block.start for block in shared[0]] == lengths


def test_scribbles_that_leave_little_open_are_a_trimap() -> None:
    inside, outside = torch.zeros(3, 10, 10), torch.zeros(3, 10, 10)
    inside[0, :2], outside[0, -1:] = 1, 1
    inside[1, :3], outside[1, -4:] = 0.5, 1
    inside[2] = 1  # no side to tell it from
    shares = trimap_share(torch.stack([inside, outside], dim=1).flatten(2))
    assert shares.tolist() == [0, 1, 0]
