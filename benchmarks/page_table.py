"""A table in a page of the documentation, written by the program that measured it."""

import argparse
from itertools import dropwhile
from pathlib import Path


def print_or_replace(description: str | None, start: str, table: str) -> None:
    """Print a Markdown table, or replace the table of the page that the command line names.

    Args:
        description: of the program.
        start: beginning of the first line of the table, by which it is recognised in the page.
        table: the new table.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, nargs="?", help="Markdown page that contains the table")
    page = parser.parse_args().page
    if page is None:
        print(table, end="")
        return
    before, line, rest = page.read_text(encoding="utf-8").partition(start)
    if not line:
        parser.error(f"{page} must have a table that begins with {start}; add this line")
    after = "".join(dropwhile(lambda line: line.startswith("|"), f"|{rest}".splitlines(keepends=True)))
    page.write_text(f"{before}{table}{after}", encoding="utf-8")
