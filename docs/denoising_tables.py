"""Tables of denoisers: ``python -m docs.denoising_tables FILE [--docs FILE]``.

FILE is the JSON of ``python -m benchmarks.denoising --out FILE``. Prints means over photographs of PSNR in dB, SSIM and
CPU seconds, and writes them between the markers of ``--docs``. Those of a public set (``--set``) are printed beside
published figures; those of a set and of repeated patterns have markers of their own.
"""

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from benchmarks.denoising.methods import METHODS
from benchmarks.denoising.sets import LEVELS
from benchmarks.harness import markdown
from docs.pages import between, write
from docs.published_denoisers import SOURCES, published

MARKERS = ("<!-- denoising: written by python -m docs.denoising_tables -->", "<!-- end of denoising -->")
TITLES = {("BM3D", "colour"): "CBM3D"}
Results = dict[str, dict[str, Any]]


def mean_of(results: Results, kind: str, level: str, method: str, figure: str) -> float | None:
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
                means = [mean_of(results, kind, level, name, figure) for level in levels]
                if figure == "seconds":  # nearly the same at all noise levels
                    known = [value for value in means if value is not None]
                    means = [statistics.mean(known)] if known else [None]
                row += ["" if value is None else format(value, form) for value in means]
            rows.append(row)
        header = [f"{kind}, noise of"]
        for title, figure, _ in figures:
            header += [title] if figure == "seconds" else [f"{title} {level}".strip() for level in levels]
        parts.append(markdown(header, rows) + f"\n\nMeans over {', '.join(photographs)}.")
    return "\n\n".join(parts)


def mean(row: Mapping[str, Mapping[str, float]], figure: str) -> float:
    """Mean of a measurement over pictures."""
    return statistics.mean(measurements[figure] for measurements in row.values())


def set_table(content: Mapping[str, Any], kind: str, *, quoted: bool) -> str:
    """A table of a set: measured rows, and published ones if they are to be ``quoted``, with their sources below.

    Args:
        content: of the file of a set: its name as ``"set"``, the number of ``"weights"`` of the network of the
            package, and ``"results"``.
        kind: ``"grey"`` or ``"colour"``.
        quoted: whether there are published figures in it.
    """
    name, results = content["set"], content["results"]
    levels = [int(key.split(", ")[1]) for key in results if key.startswith(f"{kind}, ")]
    measured = dict.fromkeys(method for level in levels for method in results[f"{kind}, {level}"])
    order = [*(name for name in METHODS if name in measured), *(name for name in measured if name not in METHODS)]
    rows = [_measured_row(content, kind, method, levels) for method in order]
    entries = published(name, kind) if quoted else ()
    for entry in entries:
        values = dict(zip(LEVELS, entry.psnr, strict=True))
        decibels = [_decibels(values.get(level)) for level in levels]
        rows.append(
            [entry.method, *decibels, "", "", "" if entry.weights is None else f"{entry.weights:,}", entry.source]
        )
    header = [f"{name}, {kind}, noise of", *map(str, levels), "SSIM at 25", "CPU s", "weights, thousands", "figures of"]
    pictures = next(iter(results[f"{kind}, {levels[0]}"].values()))
    sources = dict.fromkeys(entry.source for entry in entries)
    notes = [f"Means over {len(pictures)} pictures.", *(f"{source}: {SOURCES[source]}." for source in sources)]
    return f"{markdown(header, rows)}\n\n{fill(' '.join(notes), 120, break_on_hyphens=False)}"


def _measured_row(content: Mapping[str, Any], kind: str, method: str, levels: Sequence[int]) -> list[str]:
    known = {level: content["results"][f"{kind}, {level}"].get(method) for level in levels}
    values = [None if row is None else mean(row, "psnr") for row in known.values()]
    middle = known.get(25)
    seconds = statistics.mean(mean(row, "seconds") for row in known.values() if row is not None)
    ssim = "" if middle is None else f"{mean(middle, 'ssim'):.3f}"
    weights = f"{content['weights'] / 1000:,.0f}" if method.startswith("ours") else ""
    return [TITLES.get((method, kind), method), *map(_decibels, values), ssim, f"{seconds:.1f}", weights, "this run"]


def _decibels(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def pattern_table(content: Mapping[str, Any], key: str) -> str:
    """A table of a kind and level, such as ``"grey, 25"``: PSNR of each method, and how far "ours" is ahead of it.

    Args:
        content: with the ``"results"`` of :func:`compare`.
        key: kind and level.
    """
    rows = content["results"][key]
    groups: dict[str, list[str]] = {}
    for name in next(iter(rows.values())):
        groups.setdefault(name.split()[0], []).append(name)
    lines = []
    for method, row in rows.items():
        means = [mean({name: row[name] for name in names}, "psnr") for names in groups.values()]
        line = [
            TITLES.get((method, key.split(", ")[0]), method),
            *(f"{value:.2f}" for value in means),
            f"{mean(row, 'psnr'):.2f}",
        ]
        lead = mean(rows["ours"], "psnr") - mean(row, "psnr") if "ours" in rows and method != "ours" else None
        lines.append([*line, "" if lead is None else f"{lead:+.2f}"])
    header = [f"patterns, {key}", *(f"{group} ({len(names)})" for group, names in groups.items())]
    return markdown([*header, "mean", "ours ahead by"], lines)


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
        write(options.docs, page.encode())
    print(text)


if __name__ == "__main__":
    main()
