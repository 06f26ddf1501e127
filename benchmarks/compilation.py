"""What compilers and exporters take for a layer that builds its operator, and how far their results are from its own.

    python -m benchmarks.compilation

``torch.compile(fullgraph=True)`` by inductor, its first call and later ones beside the layer itself; ``torch.export``;
ONNX, run by onnxruntime; AOTInductor. Each in a table: seconds to make it, milliseconds of a call and of the layer,
which are called in turn, and the largest difference from the layer. ``--only`` takes some of them, ``--quick`` an image
of a few pixels and four landmarks: ``--only ahead --side 64 --landmarks 4`` is over in two minutes.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import medians, options
from benchmarks.photographs import photograph
from nlfilter_torch import NonlocalFilter, Portable, nonlocal_operator

Call = Callable[[Tensor], Tensor]
Maker = Callable[[NonlocalFilter, Tensor, Path], Call]


def compiled(layer: NonlocalFilter, image: Tensor, folder: Path) -> Call:
    """One graph, compiled by inductor in the first call."""
    fast = torch.compile(layer, fullgraph=True)
    fast(image)
    return fast


def exported(layer: NonlocalFilter, image: Tensor, folder: Path) -> Call:
    """A program of torch.export."""
    return torch.export.export(layer, (image,)).module()


def in_onnx(layer: NonlocalFilter, image: Tensor, folder: Path) -> Call:
    """A session of onnxruntime."""
    import onnxruntime

    path = str(folder / "layer.onnx")
    torch.onnx.export(Portable(layer), (image,), path, input_names=["image"], dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return lambda image: torch.from_numpy(session.run(None, {"image": image.numpy()})[0])


def ahead_of_time(layer: NonlocalFilter, image: Tensor, folder: Path) -> Call:
    """A library that is compiled from C++."""
    program, path = torch.export.export(Portable(layer), (image,)), str(folder / "layer.pt2")
    return torch._inductor.aoti_load_package(torch._inductor.aoti_compile_and_package(program, package_path=path))


SIZES = ((3, 3, 90, 61), (2, 3, 64, 200), (5, 3, 33, 40))  # of later calls of a layer compiled for (2, 3, 48, 56)
MAKERS: dict[str, Maker] = {"compile": compiled, "export": exported, "onnx": in_onnx, "ahead": ahead_of_time}


def other_sizes(layer: NonlocalFilter) -> tuple[int, float, float]:
    """Calls of a compiled layer with other sizes: compilations, slowest first call, largest difference from the layer.

    A compilation takes half a minute, so none is to happen.
    """
    torch.compiler.reset()
    fast, numbers = torch.compile(layer, dynamic=True, fullgraph=True), torch.Generator().manual_seed(0)
    fast(torch.rand(2, 3, 48, 56))
    compilations, slowest, difference = 0, 0.0, 0.0
    with torch.compiler.set_stance("fail_on_recompile"):
        for image in (torch.rand(shape, generator=numbers) for shape in SIZES):
            start = time.perf_counter()
            try:
                difference = max(difference, float((fast(image) - layer(image)).abs().max()))
            except RuntimeError:
                compilations += 1
            slowest = max(slowest, time.perf_counter() - start)
    return compilations, slowest, difference


def main() -> None:
    """Make and call each of them, and print the table."""
    parser = options("compilation", __doc__, "an image of a few pixels and four landmarks")
    parser.add_argument("--only", nargs="+", choices=list(MAKERS), default=list(MAKERS))
    parser.add_argument("--side", type=int, default=256, help="of the image, in pixels")
    parser.add_argument("--landmarks", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=9)
    chosen = parser.parse_args()
    side, landmarks = (12, 4) if chosen.quick else (chosen.side, chosen.landmarks)
    image = photograph("chelsea", side, side)
    operator = nonlocal_operator(image, num_landmarks=landmarks, photometric_bandwidth=0.1)
    keeping: dict[str, Any] = {"landmarks": operator, "hold": "features", "photometric_bandwidth": 0.1}
    layer = NonlocalFilter((3.0, 3.0, 4.0, 1.05), learn=(), **keeping).eval()
    print(f"{side}x{side}, {landmarks} landmarks, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print("| | s to make | ms a call | ms of the layer | largest difference |\n|---|---|---|---|---|")
    with TemporaryDirectory() as folder, torch.no_grad():
        expected = layer(image)
        for name in chosen.only:
            start = time.perf_counter()
            call = MAKERS[name](layer, image, Path(folder))
            made = time.perf_counter() - start
            difference = float((call(image) - expected).abs().max())
            calls = {"ours": partial(call, image), "theirs": partial(layer, image)}
            ours, theirs = (1e3 * taken for taken in medians(calls, chosen.repeats).values())
            print(f"| {name} | {made:.1f} | {ours:.1f} | {theirs:.1f} | {difference:.1e} |", flush=True)
        if "compile" in chosen.only and not chosen.quick:
            told = "{} compilations for three other sizes, slowest first call {:.2f} s, largest difference {:.1e}"
            print(told.format(*other_sizes(layer)))


if __name__ == "__main__":
    main()
