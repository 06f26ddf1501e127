"""Counterparts of the paper's figures, drawn from scikit-image's photographs: ``python -m docs.figures``.

Each function in :data:`FIGURES` takes ``size``, the longer side of its photographs in pixels, and returns a matplotlib
figure and its numbers; its docstring is the caption. The paper's Figs. 2, 4 and 5 are diagrams; Fig. 19 is part of
Table I.
"""

from collections.abc import Callable

from matplotlib.figure import Figure

from benchmarks.photographs import SIZE
from docs.figures import abstraction, accuracy, colours, focus, masks, sharpness, sliders, spectra
from docs.scenes import Numbers

Draw = Callable[..., tuple[Figure, Numbers]]

FIGURES: dict[str, Draw] = {
    "1": spectra.figure_1,
    "3": spectra.figure_3,
    "6": sliders.figure_6,
    "7": sliders.figure_7,
    "8": sliders.figure_8,
    "9": sliders.figure_9,
    "10": sliders.figure_10,
    "11": masks.figure_11,
    "12": sharpness.figure_12,
    "13": sharpness.figure_13,
    "14": colours.figure_14,
    "15": colours.figure_15,
    "16": colours.figure_16,
    "17": focus.figure_17,
    "18": abstraction.figure_18,
    "20": accuracy.figure_20,
    "table-1": accuracy.table_1,
}

__all__ = ["FIGURES", "SIZE", "Draw", "Numbers"]
