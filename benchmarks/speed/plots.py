"""Plots of a run of :mod:`benchmarks.speed`."""

import io

from matplotlib.figure import Figure

from benchmarks.speed.plan import Results, records_of

OURS, PALE, FLOOR, OTHERS = "#2a6f97", "#61a5c2", "#8a8a8a", "#c8553d"
HELD = ("slider, layers held", "response, coefficients held", "response, spectrum held", "new alpha, operator held")


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
