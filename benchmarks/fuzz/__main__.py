"""Check random operators against the library's promises: ``python -m benchmarks.fuzz --cases 10000``.

Prints one line per promise: how often it was checked and broken, and the worst value; then, for each kind of failure,
the command that reruns its worst case alone. ``--pictures`` checks photographs instead; ``--functions`` calls every
public function with random arguments, one of them invalid in half of the calls. Exits with status 1 if a promise is
broken. The cases depend on the seed alone.
"""

import argparse
import json
import re
import sys
from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path

import torch

from benchmarks.fuzz.checks import PROMISES, Figure
from benchmarks.fuzz.pictures import pictures
from benchmarks.fuzz.running import Check, Result, function_case, operator_case, picture_case, rank, results
from nlfilter_torch.photo.files.writing import open_beside

WORKERS = 2
SHOWN = 5  # kinds of warnings printed
CASES = 1000


def report(cases: list[Result], command: str) -> int:
    """Print the table and the worst case of each kind of failure; return the number of broken promises."""
    print(f"{'promise':62} {'cases':>6} {'broken':>6}  worst")
    kinds: dict[tuple[str, str], list[tuple[Result, Figure]]] = {}
    for promise in PROMISES:
        figures = [(result, figure) for result in cases for figure in result.figures if figure.promise == promise]
        if not figures:
            continue
        broken = [(result, figure) for result, figure in figures if figure.broken]
        _, worst = max(figures, key=lambda pair: rank(pair[1]))
        print(f"{promise:62} {len(figures):6d} {len(broken):6d}  {worst.value:.5g}, limit {worst.limit:g}")
        for result, figure in broken:
            kinds.setdefault((promise, re.sub(r"\d[\d.e+-]*|\(.*?\)", "#", figure.detail)), []).append((result, figure))
    warned = Counter(
        re.sub(r"\d[\d.e+-]*", "#", text.split(";")[0])[:100] for result in cases for text in result.warned
    )
    for text, count in warned.most_common(SHOWN):
        print(f"warned {count} times: {text}")
    for (promise, _), failures in kinds.items():
        result, figure = max(failures, key=lambda pair: rank(pair[1]))
        print(f"{promise}, {len(failures)} such, worst {figure.value:.5g} {figure.detail}")
        print(f"  {command} --case {result.number}  # {result.what}")
    return sum(map(len, kinds.values()))


def details(check: Check, number: int) -> int:
    """Run one case again and print all its figures; return the number of broken promises."""
    what, findings = check(number)
    print(what)
    for text in findings.warned:
        print(f"  warning: {text}")
    for figure in findings.figures:
        state = "BROKEN" if figure.broken else "kept"
        print(f"  {state:6} {figure.promise}: {figure.value:.4g}, limit {figure.limit:g} {figure.detail}")
    return len(findings.broken)


def main(arguments: list[str] | None = None) -> None:
    """Run the requested cases."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__.partition("\n")[0])
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--pictures", action="store_true", help="photographs of scikit-image over a grid of settings")
    kind.add_argument("--functions", action="store_true", help="every public function with random arguments")
    parser.add_argument("--cases", type=int, help=f"number of cases; default {CASES}, with --pictures all")
    parser.add_argument("--first", type=int, default=0, help="number of the first case; default 0")
    parser.add_argument("--case", type=int, help="run only this case and print every figure")
    parser.add_argument("--seed", type=int, default=0, help="random seed of all cases; default 0")
    parser.add_argument("--workers", type=int, choices=range(1, WORKERS + 1), default=WORKERS, help="processes")
    parser.add_argument("--out", type=Path, help="JSON with every broken promise")
    options = parser.parse_args(arguments)

    torch.set_num_threads(1)
    name = "pictures" if options.pictures else "functions" if options.functions else "operators"
    check = partial(
        {"pictures": picture_case, "functions": function_case, "operators": operator_case}[name], options.seed
    )
    if options.case is not None:
        sys.exit(min(details(check, options.case), 1))
    whole = len(pictures(options.seed)) if options.pictures else None
    count = options.cases if options.cases is not None else whole or CASES
    last = options.first + count if whole is None else min(options.first + count, whole)
    cases = list(results(check, range(options.first, last), min(options.workers, count)))
    print(f"{len(cases)} {name} from number {options.first}, seed {options.seed}")
    flag = "" if name == "operators" else f" --{name}"
    broken = report(cases, f"python -m benchmarks.fuzz{flag} --seed {options.seed}")
    if options.out is not None:
        failures = [
            {"case": result.number, "what": result.what, **asdict(figure)}
            for result in cases
            for figure in result.figures
            if figure.broken
        ]
        options.out.parent.mkdir(parents=True, exist_ok=True)
        with open_beside(options.out) as file:
            text = json.dumps({"kind": name, "seed": options.seed, "cases": len(cases), "failures": failures}, indent=1)
            file.write(text.encode())
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()
