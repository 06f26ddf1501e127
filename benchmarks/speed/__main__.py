"""Run the speed measurements, print each as it completes, and write all to a JSON file."""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import options, save_json
from benchmarks.speed.machine import describe
from benchmarks.speed.plan import QUICK, Plan, Record
from benchmarks.speed.suites import SUITES

MINUTES = 9.3  # no case starts later than this


def run(plan: Plan, names: Sequence[str], minutes: float) -> dict[str, Any]:
    """Run the suites and collect their records."""
    start = time.perf_counter()
    results: list[Record] = []
    cut: list[str] = []
    taken: dict[str, float] = {}
    machine = describe()
    print(f"{machine['processor']}, {machine['cores']} cores, load {machine['load_average']:.1f}", flush=True)
    for name in names:
        begun = time.perf_counter()
        for result in SUITES[name](plan) if is_time_left(start, minutes) else ():
            results.append(result)
            show(result)
            if not is_time_left(start, minutes):
                break
        taken[name] = time.perf_counter() - begun
        if not is_time_left(start, minutes):
            cut.append(name)
            print(f"{name}: stopped or skipped after {minutes:g} minutes", flush=True)
    return {
        "quick": plan == QUICK,
        "machine": machine,
        "seconds": time.perf_counter() - start,
        "suite_seconds": taken,
        "load_average_after": os.getloadavg()[0],
        "cut": cut,
        "results": results,
    }


def is_time_left(start: float, minutes: float) -> bool:
    """Whether at most ``minutes`` have passed since ``start``."""
    return time.perf_counter() - start <= 60 * minutes


def show(result: Record) -> None:
    """Print one record, with every time as a multiple of the floor if the floor was measured."""
    print(f"\n{result['suite']}: {result['label']}")
    floor = result.get("floor")
    for name, timing in result["timings"].items():
        multiple = f"{timing['median'] / floor['seconds']:9.3f} floors" if floor else ""
        print(f"  {name:34}{1e3 * timing['median']:10.2f} ms  (IQR {1e3 * timing['iqr']:.2f}){multiple}")
    if floor:
        print(f"  {'floor':34}{1e3 * floor['seconds']:10.2f} ms, of which a read {1e3 * floor['read']:.2f} ms")
    if "ratio" in result:
        first, second = result["timings"]
        print(
            "  {1} / {0}: {median:.2f}, quartiles {lower:.2f} to {upper:.2f} of {pairs} pairs".format(
                first, second, **result["ratio"]
            )
        )
    if "error" in result:
        print("  against float64: RMS {rms:.1e}, at most {max:.1e} grey levels".format(**result["error"]))
    if "memory" in result:
        print(
            "  {work}: {added_mib:.0f} MiB added at the peak, factor {factor_mib:.0f} MiB".format(
                work=result["work"], **result["memory"]
            )
        )
    print(*(f"  {remedy}\n" for remedy in result.get("missing", {}).values()), sep="", end="", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = options("speed", __doc__, "tiny sizes")
    add = parser.add_argument
    add("--only", nargs="+", choices=SUITES, metavar="SUITE", help=f"some of {', '.join(SUITES)}")
    add("--out", type=Path, default=Path("out/speed.json"), help="JSON file (default: %(default)s)")
    add("--device", default="cpu", help="torch device (default: %(default)s)")
    add("--minutes", type=float, default=MINUTES, help="start no case later than this (default: %(default)s)")
    chosen = parser.parse_args(arguments)
    plan = QUICK if chosen.quick else Plan(device=chosen.device)
    results = run(plan, chosen.only or list(SUITES), chosen.minutes)
    save_json(chosen.out, results)
    print(f"\n{results['seconds']:.0f} s; written to {chosen.out}")


if __name__ == "__main__":
    main()
