"""Time and peak memory of one operator in a fresh process: ``python -m benchmarks.memory [--side 1024]``.

Peaks are the kernel's high-water mark (VmHWM), which misses nothing between samples; Linux only. The first call
includes start-up costs (threads, lazy imports), later ones do not.
"""

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import skimage.data
import torch
from skimage.color import rgb2gray
from skimage.transform import resize

from nlfilter_torch import nonlocal_operator

MIB = 2**20


def resident(field: str) -> float:
    """Memory of this process in MiB: ``VmRSS`` now, or ``VmHWM`` at the peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"/proc/self/status has no {field}")


def forget_peak() -> None:
    """Reset VmHWM to the memory that is resident now."""
    Path("/proc/self/clear_refs").write_text("5")


def picture(side: int) -> torch.Tensor:
    """The middle of the retina in grey, (1, 1, side, side), enlarged if ``side`` exceeds its 1411 pixels."""
    retina = rgb2gray(skimage.data.retina())
    if side <= min(retina.shape):
        top, left = (retina.shape[0] - side) // 2, (retina.shape[1] - side) // 2
        retina = retina[top : top + side, left : left + side]
    else:
        retina = resize(retina, (side, side))
    return torch.from_numpy(np.ascontiguousarray(retina, dtype=np.float32))[None, None]


def main() -> None:
    """Print times and peaks."""
    parser = argparse.ArgumentParser(description="Time and peak memory of one operator in a fresh process.")
    parser.add_argument("--side", type=int, default=1024, help="height and width of the picture")
    parser.add_argument("--landmarks", type=int, default=100, help="number of landmarks m")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls after the first")
    options = parser.parse_args()

    image = picture(options.side)
    factor = image.numel() * options.landmarks * 4 / MIB
    forget_peak()
    before = resident("VmRSS")
    seconds = []
    for call in range(1 + options.repeats):
        start = time.perf_counter()
        operator = nonlocal_operator(image, num_landmarks=options.landmarks)
        seconds.append(time.perf_counter() - start)
        if call == 0:
            peak, after = resident("VmHWM"), resident("VmRSS")
        steps = operator.balancing_steps
        del operator
    later = sorted(seconds[1:])
    print(f"{options.side}x{options.side} grey, m = {options.landmarks}, float32, {torch.get_num_threads()} threads")
    print(
        f"time      first call {seconds[0]:.2f} s, later {statistics.median(later):.2f} s "
        f"(median of {len(later)}, {later[0]:.2f} to {later[-1]:.2f}), {steps} balancing steps"
    )
    print(f"factor    {factor:.0f} MiB")
    print(
        f"operator  {after - before:.0f} MiB kept, {peak - before:.0f} MiB at the peak "
        f"= {(peak - before) / factor:.2f} times the factor"
    )
    print(f"process   {peak:.0f} MiB at the peak, {before:.0f} MiB before (interpreter, torch, scikit-image, picture)")


if __name__ == "__main__":
    main()
