"""Tables of denoisers: ``python -m benchmarks.denoising_tables FILE [--docs FILE]``.

FILE is the JSON of ``python -m benchmarks.denoising --out FILE``. Prints means over photographs of PSNR in dB, SSIM and
CPU seconds, and writes them between the markers of ``--docs``. Those of a public set (``--set``) are printed beside
published figures; those of a set and of repeated patterns have markers of their own.
"""

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.denoising.patterns import pattern_table
from benchmarks.denoising.sets import set_table
from benchmarks.report import between, table
from nlfilter_torch.photo.files.writing import open_beside

MARKERS = ("<!-- denoising: written by python -m benchmarks.denoising_tables -->", "<!-- end of denoising -->")
Results = dict[str, dict[str, Any]]


def mean(results: Results, kind: str, level: str, method: str, figure: str) -> float | None:
    """The mean of a measurement over the photographs, or None if there is none."""
    photographs = results.get(f"{kind}, {level}", {}).get(method)
    return None if photographs is None else statistics.mean(figures[figure] for figures in photographs.values())


def tables(results: Results, figures: Sequence[tuple[str, str, str]]) -> str:
    """A table for each kind of photograph, with one row per method and one column per noise level."""
    parts = []
    for kind in dict.fromkeys(key.split(", ")[0] for key in results):
        levels = [key.split(", ")[1] for key in results if key.startswith(f"{kind}, ")]
        photographs = list(next(iter(results[f"{kind}, {levels[0]}"].values())))
        named = dict.fromkeys(name for level in levels for name in results[f"{kind}, {level}"])
        rows = []
        for name in named:
            row = ["CBM3D" if (kind, name) == ("colour", "BM3D") else name]
            for _, figure, form in figures:
                means = [mean(results, kind, level, name, figure) for level in levels]
                if figure == "seconds":  # nearly the same at all noise levels
                    known = [value for value in means if value is not None]
                    means = [statistics.mean(known)] if known else [None]
                row += ["" if value is None else format(value, form) for value in means]
            rows.append(row)
        header = [f"{kind}, noise of"]
        for title, figure, _ in figures:
            header += [title] if figure == "seconds" else [f"{title} {level}".strip() for level in levels]
        parts.append(table(header, rows) + f"\n\nMeans over {', '.join(photographs)}.")
    return "\n\n".join(parts)


def tables_of(content: Mapping[str, Any]) -> str:
    """The tables of a file, with published figures if it is of a public set."""
    if "patterns" in content:
        return "\n\n".join(pattern_table(content, key) for key in content["results"])
    if "set" not in content:
        return tables(dict(content), [("", "psnr", ".2f"), ("SSIM", "ssim", ".3f"), ("CPU s", "seconds", ".1f")])
    kinds = dict.fromkeys(key.split(", ")[0] for key in content["results"])
    return "\n\n".join(set_table(content, kind, quoted=True) for kind in kinds)


def markers_of(content: Mapping[str, Any]) -> tuple[str, str]:
    """The lines of a page between which the tables of a file are."""
    name = "patterns" if "patterns" in content else content.get("set", "denoising").lower()
    begin, end = (marker.replace("denoising", name, 1) for marker in MARKERS)
    return begin, end


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables, and write them to files."""
    parser = argparse.ArgumentParser(description="Tables from the comparison of denoisers.")
    parser.add_argument("file", type=Path, help="JSON of python -m benchmarks.denoising")
    parser.add_argument("--docs", type=Path, help="file in which the text between the markers becomes the tables")
    options = parser.parse_args(arguments)
    content = json.loads(options.file.read_text())
    text = tables_of(content)
    if options.docs is not None:
        page = between(options.docs.read_text(), text, *markers_of(content))
        with open_beside(options.docs) as stream:
            stream.write(page.encode())
    print(text)


if __name__ == "__main__":
    main()
