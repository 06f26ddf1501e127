"""Writes the table in docs/clients.md: what works with other projects and with torch, and which test shows it.

    python -m docs.clients docs/clients.md

Each test with the marker ``client("what", "how")`` is a row. Without a file the table is printed.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

from docs.pages import print_or_replace

TESTS = Path(__file__).parent.parent / "tests"
HEAD = "| | | test |\n|---|---|---|\n"
MARKER = "pytest.mark.client"


def rows() -> Iterator[tuple[str, str, str]]:
    """Yield subject, description and name of every marked test."""
    for path in sorted(TESTS.rglob("test_*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.FunctionDef):
                continue
            for call in node.decorator_list:
                if isinstance(call, ast.Call) and ast.unparse(call.func) == MARKER:
                    what, how = map(ast.literal_eval, call.args)
                    yield what, how, node.name


def table() -> str:
    """The table, sorted by subject."""
    lines: dict[tuple[str, str], list[str]] = {}
    for what, how, test in rows():
        lines.setdefault((what, how), []).append(f"`{test}`")
    ordered = sorted(lines.items(), key=lambda line: line[0][0].strip("`").lower())
    return HEAD + "".join(f"| {what} | {how} | {', '.join(tests)} |\n" for (what, how), tests in ordered)


def main() -> None:
    """Print the table, or replace the table in a page."""
    print_or_replace(__doc__, HEAD.splitlines()[0], table())


if __name__ == "__main__":
    main()
