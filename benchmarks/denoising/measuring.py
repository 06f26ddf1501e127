"""Measurement of denoisers on photographs."""

import statistics
import time
from collections.abc import Mapping, Sequence

from benchmarks.denoising.cases import Case, Figures, psnr, ssim
from benchmarks.denoising.methods import Method


def judge(method: Method, case: Case) -> Figures:
    """Run a method on a photograph and measure the result."""
    start = time.process_time()
    estimate = method(case)
    seconds = time.process_time() - start
    return Figures(psnr(estimate, case.clean), ssim(estimate.clamp(0, 1), case.clean), seconds)


def table(methods: Mapping[str, Method], cases: Sequence[Case]) -> dict[str, dict[str, Figures]]:
    """Print the PSNR of each photograph and the means of all measurements, one row per method."""
    print(f"{'':22}" + "".join(f"{case.name[:9]:>10}" for case in cases) + f"{'mean':>10}{'SSIM':>8}{'CPU s':>8}")
    rows: dict[str, dict[str, Figures]] = {}
    for name, method in methods.items():
        rows[name] = {case.name: judge(method, case) for case in cases}
        results = list(rows[name].values())
        mean = [
            statistics.mean(getattr(figures, which) for figures in results) for which in ("psnr", "ssim", "seconds")
        ]
        line = "".join(f"{figures.psnr:10.2f}" for figures in results)
        print(f"{name:22}{line}{mean[0]:10.2f}{mean[1]:8.4f}{mean[2]:8.2f}", flush=True)
    return rows
