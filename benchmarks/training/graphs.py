"""The choice of landmarks as CUDA graphs, for training on a GPU.

It is a loop of thousands of small kernels, two thirds of all that a step launches, and launching them one by one keeps
the processor busy for longer than the GPU works. A graph launches them at once.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from nlfilter_torch.operator import landmarks

Key = tuple[torch.Size, torch.Size, float]


class GraphedPivots:
    """:func:`nlfilter_torch.core.kernels.clusters.pivots` with one graph for each shape of its arguments.

    The first call with a shape captures its graph. Meanwhile, no other thread may allocate memory of the device.
    """

    def __init__(self) -> None:
        self.eager = landmarks.pivots
        self.graphs: dict[Key, tuple[torch.cuda.CUDAGraph, Tensor, Tensor, Tensor]] = {}

    def __call__(self, points: Tensor, draws: Tensor, captured: float) -> Tensor:
        """Pivots (B, M) of points (B, D, S), as the function in place of which it is called."""
        key = points.shape, draws.shape, captured
        if key not in self.graphs:
            self.graphs[key] = self._captured(points.detach().clone(), draws.clone(), captured)
        graph, own_points, own_draws, chosen = self.graphs[key]
        own_points.copy_(points)
        own_draws.copy_(draws)
        graph.replay()
        return chosen.clone()

    def _captured(
        self, points: Tensor, draws: Tensor, captured: float
    ) -> tuple[torch.cuda.CUDAGraph, Tensor, Tensor, Tensor]:
        """A graph with its arguments and its result."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # libraries set themselves up in the first calls, which no graph may contain
            for _ in range(2):
                self.eager(points, draws, captured)
        torch.cuda.current_stream().wait_stream(stream)
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            chosen = self.eager(points, draws, captured)
        return graph, points, draws, chosen


@contextmanager
def graphed_pivots(device: str) -> Iterator[None]:
    """Choose landmarks by graphs on a CUDA device, and as usual on others."""
    if not device.startswith("cuda"):
        yield
        return
    graphed = GraphedPivots()
    landmarks.pivots = graphed
    try:
        yield
    finally:
        landmarks.pivots = graphed.eager
