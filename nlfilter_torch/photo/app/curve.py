"""The tone curve of the editor: a slider for each of its points, over the curve and a histogram."""

from collections.abc import Callable
from functools import partial

import torch
from nicegui import ui

from nlfilter_torch.photo.app.controls import SteadySlider
from nlfilter_torch.photo.declared.development import EVEN_CURVE
from nlfilter_torch.photo.picture.light import on_curve

Curve = tuple[float, ...]
STEPS = 64  # of the line that is drawn
MOST_POINTS = 9  # for which there is room; a longer curve is shown alone


class CurveEditor:
    """The curve, built into the open element; ``change`` takes a curve, and whether the change is complete."""

    def __init__(self, change: Callable[[Curve, bool], None]) -> None:
        self._change = change
        self._curve: Curve = EVEN_CURVE
        self._points: list[SteadySlider] = []
        with ui.row().classes("w-full items-center no-wrap"):
            ui.label("Curve").classes("group")
            ui.space()
            reset = ui.button("Straight", on_click=lambda: change(EVEN_CURVE, True)).props("flat dense no-caps")
            self._reset = reset.tooltip("Leave all tones as they are")
        with ui.element("div").classes("tones"):
            self._histogram = ui.html("", sanitize=False).classes("behind")
            self._line = ui.html("", sanitize=False).classes("behind")
            self._box = ui.element("div").classes("points").props('role="group" aria-label="Points of the curve"')
        self._build()

    def follow(self, curve: Curve) -> None:
        """Show a curve."""
        is_longer, self._curve = len(curve) != len(self._curve), curve
        if is_longer:
            self._build()
        for point, value in zip(self._points, curve, strict=False):
            point.set_value(value)
        self._draw()

    def draw_tones(self, histogram: str) -> None:
        """Show a histogram behind the curve."""
        self._histogram.set_content(histogram)

    def _build(self) -> None:
        """Build the sliders of the points."""
        self._box.clear()
        self._points = []
        if len(self._curve) <= MOST_POINTS:
            with self._box:
                self._points = [self._point(number, value) for number, value in enumerate(self._curve)]
        self._draw()

    def _point(self, number: int, value: float) -> SteadySlider:
        tone = number / (len(self._curve) - 1)
        point = SteadySlider(min=0, max=1, step=0.01, value=value)
        point.props(f'vertical reverse dense aria-label="Curve at {100 * tone:.0f} %"').classes("point")
        point.on_value_change(lambda event: self._moved(number, event.value))
        point.on("change", lambda event: self._set(number, float(event.args), True))
        point.on_reset(partial(self._set, number, tone, True))
        return point

    def _moved(self, number: int, value: float | None) -> None:
        if value is not None and value != self._curve[number]:  # otherwise it follows the edit
            self._set(number, value, False)

    def _set(self, number: int, value: float, complete: bool) -> None:
        self._curve = (*self._curve[:number], round(value, 4), *self._curve[number + 1 :])
        self._draw()
        self._change(self._curve, complete)

    def _draw(self) -> None:
        tones = torch.linspace(0, 1, STEPS + 1)
        bent = tones if self._curve == EVEN_CURVE else on_curve(tones, self._curve)  # which takes an import
        pairs = zip(tones.tolist(), bent.tolist(), strict=True)
        line = " ".join(f"{100 * x:.1f},{100 - 100 * y:.1f}" for x, y in pairs)
        self._line.set_content(
            '<svg viewBox="0 0 100 100" preserveAspectRatio="none" role="img" aria-label="tone curve">'
            f'<polyline points="0,100 100,0" class="unit" /><polyline points="{line}" class="curve" /></svg>'
        )
        self._reset.set_enabled(self._curve != EVEN_CURVE)
