"""Fig. 20 and Table I: how much of a photograph its eigenvectors capture."""

import matplotlib
from matplotlib.figure import Figure

from benchmarks.photographs import SIZE
from docs import tables
from docs.scenes import Numbers, rounded
from nlfilter_torch import estimate_bandwidth

PICTURES = ("coffee", "chelsea", "astronaut", "camera")
LEVELS = (2, 4, 6, 8, 10)  # h_y of the paper's Table I, in units of its own patch weights
OWN_UNIT = 4.2  # ratio of a bandwidth under patch weights of unit sum to the paper's
PAPER, DEFAULTS = tables.METHODS


def figure_20(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Residual of a photograph under the m leading eigenvectors of 150 landmarks: relative RMSE in %, auto bandwidth.

    Left: the paper's method. Right: the library's defaults, whose eigenvectors capture less, since the span of the
    factor need not contain the constant; the library's filters keep the residual, the paper's drop it. The paper
    reports about 1 % for m > 75.
    """
    figure = Figure(figsize=(10, 4.5), dpi=100, layout="constrained")
    numbers: Numbers = {}
    colours = matplotlib.colormaps["tab10"].colors  # type: ignore[attr-defined]
    axes = figure.subplots(1, 2, sharey=True)
    for axis, (method, options) in zip(axes, tables.METHODS.items(), strict=True):
        for colour, name in zip(colours, PICTURES, strict=False):
            missed = [captured.relative_rmse for captured in tables.figure_20(name, size, options)]
            axis.plot(tables.COUNTS, missed, marker="o", markersize=4, color=colour, label=name)
            numbers.setdefault(method, {})[name] = dict(
                zip((f"m = {count}" for count in tables.COUNTS), (rounded(value, 2) for value in missed), strict=True)
            )
        axis.set(title=method, xlabel="eigenvectors m", ylabel="relative RMSE in %")
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.3)
        axis.legend()
    axes[0].set_ylim(bottom=0)  # after all curves are drawn
    return figure, numbers


def table_1(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Energy in per cent captured by 100 eigenvectors, over the bandwidth in grey levels; mean gradients as in Fig. 19.

    Bandwidths are the paper's 2 to 10, multiplied by 4.2 to account for its patch weights, and the automatic one. A
    dash means that the paper's method gave no filter (row sums off by more than 0.01).
    """
    numbers: Numbers = {}
    rows, labels = [], []
    for method, options in tables.METHODS.items():
        for name in PICTURES:
            image = tables.picture(name, size)
            auto = float(estimate_bandwidth(image))
            widths = [level * OWN_UNIT / 255 for level in LEVELS] + [auto]
            measured = [tables.measure(image, width, tables.LANDMARKS, options) for width in widths]
            gradient = f"{255 * auto / 2.5:.1f}"
            cells = ["–" if result.failed else f"{100 * result.beta:.2f}" for result in measured]
            kind = "paper's method" if method == PAPER else "defaults"
            labels.append(f"{name}, {kind}")
            rows.append([gradient, f"{255 * auto:.0f}", *cells])
            numbers[labels[-1]] = {
                "mean gradient": float(gradient),
                "auto h_y": rounded(255 * auto, 1),
                **{f"h_y {level}": cell for level, cell in zip([*LEVELS, "auto"], cells, strict=True)},
            }
    figure = Figure(figsize=(11, 3.1), dpi=100)
    axis = figure.add_axes((0.2, 0.01, 0.79, 0.98))
    axis.set_axis_off()
    head = ["gradient", "auto h_y", *(f"β, {level} x 4.2" for level in LEVELS), "β, auto"]
    drawn = axis.table(rows, colLabels=head, rowLabels=labels, loc="center", cellLoc="center")
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    drawn.scale(1, 1.6)
    return figure, numbers
