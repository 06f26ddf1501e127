"""Records the results of the package, and compares those of two versions.

    python -m benchmarks.results --out before.json
    python -m benchmarks.results --compare before.json after.json

Results are those of command lines, with the files they write, of every public function and module, with gradients, and
of wrong inputs. The comparison prints all differences, and exits with 1 if there is any.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from difflib import unified_diff
from pathlib import Path

import torch

from benchmarks.results import calls, commands
from benchmarks.results.digests import Digest

MISSING = "(missing)"
Sections = dict[str, dict[str, Digest]]


def recorded() -> Sections:
    """All results, by section and name."""
    torch.set_num_threads(1)
    sections: Sections = {}
    for name, results in (
        ("commands", commands.results()),
        ("calls", calls.results()),
        ("wrong calls", calls.wrong()),
    ):
        start = time.perf_counter()
        sections[name] = dict(results)
        print(f"{len(sections[name])} {name} in {time.perf_counter() - start:.0f} s", file=sys.stderr)
    return sections


def differences(before: Digest, after: Digest, place: str) -> Iterator[str]:
    """Describe what differs between two digests found at the same place."""
    if isinstance(before, list) and isinstance(after, list):
        before, after = ({str(number): entry for number, entry in enumerate(side)} for side in (before, after))
    if isinstance(before, dict) and isinstance(after, dict):
        for name in {**before, **after}:
            yield from differences(before.get(name, MISSING), after.get(name, MISSING), f"{place} > {name}")
    elif before == after:
        return
    elif MISSING in (before, after):
        yield f"{place}\n    only {'before' if after == MISSING else 'after'}"
    else:
        old, new = (text.splitlines() if isinstance(text, str) else [json.dumps(text)] for text in (before, after))
        yield "\n    ".join([place, *list(unified_diff(old, new, n=0, lineterm=""))[3:]])


def compare(before: Path, after: Path) -> int:
    """Print the differences of two files of results, and return the exit status."""
    old, new = (json.loads(path.read_text(encoding="utf-8")) for path in (before, after))
    names = [(section, name) for section in {**old, **new} for name in {**old.get(section, {}), **new.get(section, {})}]
    unequal = 0
    for section, name in names:
        first, second = (results.get(section, {}).get(name, MISSING) for results in (old, new))
        lines = list(differences(first, second, f"{section} > {name}"))
        unequal += bool(lines)
        print("".join(f"{line}\n" for line in lines), end="")
    print(f"{len(names) - unequal} of {len(names)} results are equal")
    return 1 if unequal else 0


def main() -> int:
    """Record or compare results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--out", type=Path, help="JSON file for the results")
    action.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), help="two such files")
    arguments = parser.parse_args()
    if arguments.compare:
        return compare(*arguments.compare)
    arguments.out.write_text(json.dumps(recorded(), indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
