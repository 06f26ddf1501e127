"""Images of any size: padded batches with weights, and programs of torch for sizes that they were not made with.

Landmarks are those of the image without padding, as features, so that the comparison is of what follows from them. The
pictures are others than those of the tests.
"""

import time
from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn

from benchmarks.photographs import photograph
from benchmarks.training.figures import Figure
from nlfilter_torch import (
    NonlocalFilter,
    NonlocalOperator,
    diffusion_mask,
    nonlocal_operator,
    polynomial_filter,
    propagate_strokes,
    segment_mask,
)

PICTURES = ("rocket", "immunohistochemistry", "hubble_deep_field")
ALPHA = (3.0, 2.0, 1.05)
SIZES = ((3, 3, 90, 61), (2, 3, 64, 200), (5, 3, 33, 40))  # of later calls; programs are made with (2, 3, 48, 56)
LIMIT = 1e-5


def measure(quick: bool) -> Iterable[Figure]:
    """Padding, export, and compiled programs."""
    yield from _padding(64 if quick else 192)
    yield from _export()
    if not quick:  # compiling takes a minute
        yield from _compile()


def _outputs(operator: NonlocalOperator, image: Tensor, region: Tensor) -> dict[str, Tensor]:
    """What is computed from an operator: filtered images and masks."""
    spectrum = operator.spectrum()
    return {
        "filtered images": polynomial_filter(operator, image, torch.tensor(ALPHA).to(image)),
        "diffusion masks": diffusion_mask(spectrum, region),
        "segment masks": segment_mask(spectrum, torch.cat([region, 1 - region], dim=1)),
        "values spread from strokes": propagate_strokes(spectrum, image, region),
    }


def _padding(side: int) -> Iterable[Figure]:
    """Padded images against the same without padding."""
    height, width, hidden = side * 3 // 4, side * 5 // 8, (slice(None), slice(None))
    for dtype in (torch.float32, torch.float64):
        worst: dict[str, float] = {}
        moved = 0.0
        for name in PICTURES:
            image = photograph(name, height, width).to(dtype)
            image = image.expand(-1, 3, -1, -1)
            batch, weights = (torch.zeros(1, channels, side, side, dtype=dtype) for channels in (3, 1))
            inside = (*hidden, slice(height), slice(width))
            batch[inside], weights[inside] = image, 1
            region, regions = torch.zeros(1, 1, height, width, dtype=dtype), torch.zeros_like(weights)
            region[..., height // 3 : height // 2, width // 3 : width // 2] = 1
            regions[inside] = region
            options = {"photometric_bandwidth": 20 / 255, "num_landmarks": 100}
            alone = nonlocal_operator(image, **options)  # type: ignore[arg-type]
            given = options | {"landmarks": alone.landmarks}
            padded = nonlocal_operator(batch, weights=weights, **given)  # type: ignore[arg-type]
            results = _outputs(padded, batch, regions)
            for kind, part in _outputs(alone, image, region).items():
                difference = float((results[kind][inside] - part).abs().max())
                worst[kind] = max(worst.get(kind, 0.0), difference)
            without = nonlocal_operator(batch, **given) @ batch  # type: ignore[arg-type]
            moved = max(moved, float((without[inside] - alone @ image).abs().max()) * 255)
        precision = str(dtype).removeprefix("torch.")
        for kind, difference in worst.items():
            yield Figure(f"padding moves {kind}, {precision}", difference, LIMIT)
        yield Figure(f"padding without weights moves W y, {precision}", moved, unit="levels")


def _layer() -> NonlocalFilter:
    return NonlocalFilter(
        ALPHA, photometric_bandwidth=20 / 255, num_landmarks=50, learn=("alpha", "photometric_bandwidth")
    )


def _differences(program: Callable[[Tensor], Tensor], layer: nn.Module) -> float:
    """Largest difference from the layer over the sizes."""
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(shape, generator=generator) for shape in SIZES]
    return max(float((program(image) - layer(image)).detach().abs().max()) for image in images)


def _export() -> Iterable[Figure]:
    """A program with dynamic height, width and batch."""
    layer = _layer()
    batch, height, width = (torch.export.Dim(name, min=low) for name, low in (("n", 1), ("h", 16), ("w", 16)))
    program = torch.export.export(
        layer, (torch.rand(2, 3, 48, 56),), dynamic_shapes={"image": {0: batch, 2: height, 3: width}}
    ).module()
    yield Figure("exported with dynamic sizes: largest difference from the layer", _differences(program, layer), LIMIT)


def _compile() -> Iterable[Figure]:
    """A compiled layer, called with one size and then with others."""
    layer = _layer()
    torch.compiler.reset()
    fast = torch.compile(layer, dynamic=True, fullgraph=True)
    start = time.perf_counter()
    fast(torch.rand(2, 3, 48, 56))
    yield Figure("compiled by inductor: first call", time.perf_counter() - start, unit="s")
    slowest, compilations = 0.0, 0
    with torch.compiler.set_stance("fail_on_recompile"):
        for shape in SIZES:
            start = time.perf_counter()
            try:
                fast(torch.rand(shape))
            except RuntimeError:
                compilations += 1
            slowest = max(slowest, time.perf_counter() - start)
    yield Figure("compilations for three other sizes", compilations, 0)
    yield Figure("slowest first call of another size (27 s before)", slowest, 1.0, "s")
    yield Figure("compiled: largest difference from the layer", _differences(fast, layer), LIMIT)
