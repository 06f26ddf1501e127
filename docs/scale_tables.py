"""The tables of docs/scale.md, from a file of ``benchmarks.streaming --out``: ``python -m docs.scale_tables FILE``."""

import json
import sys
from pathlib import Path
from typing import Any

from nlfilter_torch.photo.declared.steps import working_bytes


def tables(figures: dict[str, Any]) -> None:
    """Print the tables of docs/scale.md from the JSON of a run."""
    print("| megapixels | m | statistics | CPU, s | s per MP | peak over start, MiB |\n|---|---|---|---|---|---|")
    for run in figures["runs"]:
        cpu, pixels = run["cpu_s"], run["megapixels"]
        kinds = f"{pixels:.1f} | {run['landmarks']} | {run['statistics']}"
        print(f"| {kinds} | {cpu:.1f} | {cpu / pixels:.2f} | {run['peak_mib']:.0f} |")
    large = max(figures["runs"], key=lambda run: run["megapixels"])
    once = sum(large["stages_s"][name] for name in ("Balancing", "Summing up"))
    rate = (large["cpu_s"] - once) / large["megapixels"]
    whole = figures["exactness"]["memory_cpu_s"] / figures["exactness"]["megapixels"]
    print("\n| workers | way | time | memory of each |\n|---|---|---|---|")
    print(f"| 1 | rows | {(1000 * rate + once) / 60:.0f} min | {large['peak_mib'] / 1024:.1f} GiB |")
    for workers in (8, 64):
        memory = 1e9 / workers * working_bytes(large["landmarks"], 5) / 2**30
        print(f"| {workers} | shards | {1000 * whole / workers / 60:.1f} min | {memory:.0f} GiB |")
    print(f"\n{rate:.2f} s per MP by rows and {once:.1f} s once; {whole:.2f} s per MP in memory")


if __name__ == "__main__":
    tables(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
