"""Tables and plots from the JSON of :mod:`benchmarks.speed`: ``python -m docs.speed FILE.json``.

Writes ``speed.md`` and two plots into a folder, and a copy of the JSON if that is a different folder. With ``--page``
the report is written between the two marker comments of that file instead of ``speed.md``, so that no number is copied
by hand: ``python -m docs.speed out/speed.json --folder docs --page docs/speed.md``.
"""

import argparse
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks import harness
from benchmarks.harness import markdown
from benchmarks.speed.claims import claims
from benchmarks.speed.comparisons import SUITE
from benchmarks.speed.floor import READS
from benchmarks.speed.plan import Record, Results, records_of
from docs.pages import between, write

OURS, PALE, FLOOR, OTHERS = "#2a6f97", "#61a5c2", "#8a8a8a", "#c8553d"
HELD = ("slider, layers held", "response, coefficients held", "response, spectrum held", "new alpha, operator held")
BEGIN, END = "<!-- speed: written by python -m docs.speed -->", "<!-- end of speed -->"
SERIES = {
    "sizes": ("Over the size of the image", "image", lambda case: f"{case['height']}x{case['width']}"),
    "landmarks": ("Over the number of landmarks", "m", lambda case: str(case["landmarks"])),
    "patches": ("Over the size of the patches", "patch", lambda case: f"{case['patch_size']}x{case['patch_size']}"),
    "dtypes": ("Over number types (half precision is computed in float32)", "type", lambda case: case["dtype"]),
    "threads": ("Over threads", "threads", lambda case: str(case["threads"])),
}


def claims_table(entries: Sequence[harness.Figure]) -> str:
    """A table of claims: limit, measured value, with quartiles where calls alternated, and whether the claim holds."""

    def shown(claim: harness.Figure, value: float | None) -> str:
        digits = 0 if claim.unit == "MiB" else 1 if value is not None and value >= 20 else 2
        return "" if value is None else f"{value:.{digits}f} {claim.unit}".rstrip()

    rows = [
        [
            claim.name,
            f"{'at most' if claim.at_most else 'at least'} {shown(claim, claim.limit)}",
            shown(claim, claim.value) + (" ({:.2f} to {:.2f})".format(*claim.quartiles) if claim.quartiles else ""),
            "holds" if claim.holds else "**falls short**",
        ]
        for claim in entries
    ]
    return markdown(["claim", "limit", "measured", "verdict"], rows)


def main_table(results: Results) -> str:
    """A table of operator, sliders and other filters on one image, fastest first."""
    main = records_of(results, "main")[0]
    floor = main["floor"]["seconds"]
    entries = [(name, timing, main) for name, timing in main["timings"].items() if ": " not in name]
    for record in records_of(results, "slow"):
        entries += [(name, timing, record) for name, timing in record["timings"].items() if name != "operator"]
    does = {"operator": "**this filter, built from the image**", "spectrum": "eigenvalues and m x m core"}
    rows = [
        [
            name,
            seconds(timing["median"]),
            seconds(timing["iqr"]),
            f"{timing['median'] / floor:.3f}",
            f"{timing['median'] / record['timings']['operator']['median']:.3f}",
            record["does"].get(name, does.get(name, "")),
        ]
        for name, timing, record in sorted(entries, key=lambda entry: entry[1]["median"])
    ]
    return markdown(["what", "median", "IQR", "floors", "operators", "what it computes"], rows)


def series_table(records: Sequence[Record], column: str, key: Any) -> str:
    """A table with one row per case: operator, one filtering, backward, error."""

    def cell(record: Record, name: str) -> list[str]:
        timing = record["timings"].get(name)
        if timing is None:
            return ["", ""]
        return [seconds(timing["median"]), f"{timing['median'] / record['floor']['seconds']:.2f}"]

    rows = [
        [
            key(record["case"]),
            seconds(record["floor"]["seconds"]),
            *cell(record, "operator"),
            *cell(record, "apply"),
            *cell(record, "backward"),
            "{rms:.1e}".format(**record["error"]) if "error" in record else "",
        ]
        for record in records
    ]
    header = [column, "floor", "operator", "floors", "filter, k = 3", "floors", "backward", "floors", "error (RMS)"]
    return markdown(header, rows)


def comparisons_table(records: Sequence[Record]) -> str:
    """A table with two alternating calls per row: the median of each, and median and quartiles of paired ratios."""
    rows = []
    for record in records:
        ratio, (first, second) = record["ratio"], record["timings"].items()
        rows.append(
            [
                record["label"],
                *(f"{name}: {seconds(timing['median'])}" for name, timing in (first, second)),
                f"{ratio['median']:.2f}",
                f"{ratio['lower']:.2f} to {ratio['upper']:.2f}",
                str(ratio["pairs"]),
            ]
        )
    return markdown(["comparison", "first", "second", "second / first", "quartiles", "pairs"], rows)


def other_tables(results: Results) -> list[str]:
    """Sections for all suites that are not a series with a floor."""
    compared = records_of(results, SUITE)
    parts = [f"## Two at a time, alternating\n\n{comparisons_table(compared)}"] if compared else []
    for suite, title in (
        ("pictures", "Other photographs, enlarged or reduced, taking turns"),
        ("dense", "Beside the dense filter, on an image that it can do"),
        ("autograd", "Beside the same filter in plain autograd"),
        ("pauses", "In a loop, and after idle seconds"),
        ("imports", "Imports, one after the other in fresh processes"),
    ):
        rows = [
            [_case_name(record), name, seconds(timing["median"]), seconds(timing["iqr"])]
            for record in records_of(results, suite)
            for name, timing in record["timings"].items()
        ]
        if rows:
            parts.append(f"## {title}\n\n" + markdown(["case", "what", "median", "IQR"], rows))
    rows = [
        [
            record["label"],
            record["work"],
            f"{record['memory']['factor_mib']:.0f}",
            f"{record['memory']['added_mib']:.0f}",
            f"{record['memory']['added_mib'] / record['memory']['factor_mib']:.2f}",
        ]
        for record in records_of(results, "memory")
    ]
    if rows:
        header = ["case", "work", "factor, MiB", "added at the peak, MiB", "factors"]
        parts.append("## Peak memory of fresh processes\n\n" + markdown(header, rows))
    return parts


def _case_name(record: Record) -> str:
    """The part of a record that distinguishes it from others of its suite."""
    if record["suite"] == "imports":
        return "a fresh process"
    if record["suite"] == "pictures":
        return f"{record['case']['picture']}, {record['steps']} balancing steps"
    return record["label"]


def machine_lines(results: Results) -> str:
    """Describe the machine and the run."""
    machine = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    kind = " **A quick run on tiny sizes: its figures say nothing about speed.**" if results["quick"] else ""
    return (
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, {machine['instructions']}, "
        f"kernels in C: {machine['kernels']}, {machine['memory_gib']} GiB; Python {machine['python']}, {versions}; "
        f"commit {machine['commit']}, {machine['started']}; load average {machine['load_average']:.1f} before the run, "
        f"which took {results['seconds'] / 60:.1f} minutes.{kind}"
    )


def explanation(results: Results) -> str:
    """Explain the measurements and the floor."""
    main = next(iter(records_of(results, "main")), None)
    if main is None:
        return ""
    floor = main["floor"]
    return (
        "Times are medians of calls that alternate on the same image, each after an uncounted call, as in a loop over "
        "pictures; the cost of a call after idle seconds is measured separately. A claim with quartiles compares two "
        "calls that alternate: its figure is the median of the ratios of neighbouring samples. The floor is the "
        "minimum cost with "
        "the matrix products of torch: "
        f"N x D x M and twice N x M x M ({seconds(floor['products'])} here) and {READS} reads of the factor "
        f"({seconds(floor['read'])} each). Each of these is timed in several ways beside the other calls, and the "
        "fastest way counts. The floor excludes exponentials, features, landmarks and allocating the factor. The "
        "kernels in C skip the zero "
        "triangle of the inverse Cholesky factor, so the operator may be faster than the floor. The other filters are "
        "different operators for the same task."
    )


def report(results: Results) -> str:
    """The whole report in markdown, without its title."""
    parts = [machine_lines(results), explanation(results), "## Claims", claims_table(claims(results))]
    missing = [remedy for record in results["results"] for remedy in record.get("missing", {}).values()]
    if any(records_of(results, "main")):
        parts += ["## On one image", *missing, main_table(results)]
    for suite, (title, column, key) in SERIES.items():
        records = list(records_of(results, suite))
        if records:
            parts += [f"## {title}", series_table(records, column, key)]
    parts += other_tables(results)
    parts += [f"Time was up during or before: {', '.join(results['cut'])}."] if results["cut"] else []
    return "\n\n".join(part for part in parts if part)


def seconds(value: float) -> str:
    """Format a time in seconds or milliseconds, with three significant digits."""
    scaled, unit = (value, "s") if value >= 1 else (1e3 * value, "ms")
    digits = 0 if scaled >= 100 else 1 if scaled >= 10 else 2
    return f"{scaled:.{digits}f} {unit}"


def plot_growth(results: Results) -> Figure:
    """Plot time over pixels and over landmarks, whichever were measured, with the floor."""
    panels = [
        (suite, label, size, records)
        for suite, label, size in (
            ("sizes", "pixels", lambda case: case["height"] * case["width"]),
            ("landmarks", "landmarks m", lambda case: case["landmarks"]),
        )
        if (records := records_of(results, suite))
    ]
    figure = Figure(figsize=(5.5 * len(panels), 4.6), dpi=110, layout="constrained")
    for axis, (suite, label, size, records) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        for name, colour, title in (
            ("backward", OTHERS, "backward pass"),
            ("operator", OURS, "operator"),
            ("apply", PALE, "one filtering with it, k = 3"),
        ):
            timed = [record for record in records if name in record["timings"]]
            across = [size(record["case"]) for record in timed]
            axis.plot(across, [r["timings"][name]["median"] for r in timed], marker="o", color=colour, label=title)
        floors = [record["floor"]["seconds"] for record in records]
        across = [size(record["case"]) for record in records]
        axis.plot(across, floors, linestyle="--", color=FLOOR, label="floor of the operator")
        first = records[0]["case"]
        rest = f"m = {first['landmarks']}" if suite == "sizes" else f"{first['height']}x{first['width']}"
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="seconds, median")
        if suite == "landmarks":  # the default labels of a logarithmic axis would overlap
            axis.set_xticks(across, labels=[str(count) for count in across])
            axis.set_xticks([], minor=True)
        axis.set_title(f"Time over {label} ({rest}, {first['threads']} threads)")
        axis.grid(which="both", alpha=0.25)
        axis.legend()
    return figure


def plot_peers(results: Results) -> Figure:
    """Plot the times of operator, sliders and peers on one image as bars."""
    main = records_of(results, "main")[0]
    bars = {name: t["median"] for name, t in main["timings"].items() if ": " not in name}
    for record in records_of(results, "slow"):
        bars |= {name: t["median"] for name, t in record["timings"].items() if name != "operator"}
    bars["floor of the operator"] = main["floor"]["seconds"]
    names = sorted(bars, key=lambda name: bars[name], reverse=True)
    ours = {"operator", "spectrum", "detail_layers", *HELD}
    colours = [OURS if name in ours else FLOOR if name.startswith("floor") else OTHERS for name in names]
    figure = Figure(figsize=(10, 0.42 * len(names) + 1.2), dpi=110, layout="constrained")
    axis = figure.subplots()
    drawn = axis.barh(names, [bars[name] for name in names], color=colours)
    axis.bar_label(drawn, labels=[seconds(bars[name]) for name in names], padding=4)
    axis.set(xscale="log", xlabel="seconds, median (logarithmic)")
    axis.set_title(f"{main['label']}: this filter (blue), its floor (grey), other filters (red)")
    axis.margins(x=0.12)
    axis.grid(axis="x", alpha=0.25)
    axis.set_axisbelow(True)
    return figure


def png(figure: Figure) -> bytes:
    """Render a figure as the bytes of a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m docs.speed", description=__doc__)
    parser.add_argument("file", type=Path, help="JSON of python -m benchmarks.speed")
    parser.add_argument("--folder", type=Path, help="path of the report (default: beside FILE)")
    parser.add_argument("--page", type=Path, help="file in which the text between the markers becomes the report")
    options = parser.parse_args(arguments)
    results = json.loads(options.file.read_text())
    folder = options.folder or options.file.parent
    if folder.resolve() != options.file.parent.resolve():
        write(folder / "speed.json", options.file.read_bytes())
    text = report(results)
    if options.page is None:
        write(folder / "speed.md", f"# Speed\n\n{text}\n".encode())
    elif results["quick"] or not records_of(results, "main"):
        sys.exit("the page takes figures of a full run only; run python -m benchmarks.speed without --quick")
    else:
        write(options.page, between(options.page.read_text(), text, BEGIN, END).encode())
    if records_of(results, "sizes") or records_of(results, "landmarks"):
        write(folder / "speed_growth.png", png(plot_growth(results)))
    if records_of(results, "main"):
        write(folder / "speed_peers.png", png(plot_peers(results)))
    print(text)


if __name__ == "__main__":
    main()
