"""Parts of pages of the documentation, written by the programs that measure them."""

import argparse
from itertools import dropwhile
from pathlib import Path

from nlfilter_torch.photo.files.writing import open_beside


def write(path: Path, content: bytes) -> None:
    """Write a file completely or not at all; its folder is created if it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_beside(path) as stream:
        stream.write(content)


def between(text: str, part: str, begin: str, end: str) -> str:
    """Replace the part of ``text`` between two markers.

    Raises:
        ValueError: if a marker is missing.
    """
    before, first, rest = text.partition(begin)
    _, last, after = rest.partition(end)
    if not first or not last:
        raise ValueError(f"the file must hold the lines {begin!r} and {end!r}, got neither or one; add both")
    return f"{before}{begin}\n\n{part}\n\n{end}{after}"


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
