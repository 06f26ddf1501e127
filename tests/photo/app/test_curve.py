"""The tone curve of the editor, without a browser."""

import pytest
from nicegui import Client, ui

from nlfilter_torch.photo.app.curve import MOST_POINTS, CurveEditor
from nlfilter_torch.photo.declared.development import EVEN_CURVE
from tests.photo.app.page_controls import Controls


def send(slider: ui.slider, kind: str) -> None:
    for listener in list(slider._event_listeners.values()):
        if listener.type == kind:
            listener.handler(None)


def test_points_show_and_change_the_curve(client: Client) -> None:
    shown, changes = Controls(client), []
    editor = CurveEditor(lambda *change: changes.append(change))
    assert list(shown.sliders().values()) == list(EVEN_CURVE)
    straight = shown.button("Straight")
    assert not straight.enabled
    point = shown.of(ui.slider)[1]
    point.set_value(0.3)
    assert changes == [((0.0, 0.3, 0.5, 0.75, 1.0), False)]
    editor.follow((0.0, 0.3, 0.5, 0.75, 1.0))
    assert straight.enabled
    send(point, "dblclick")
    shown.click("Straight")
    assert changes[1:] == [(EVEN_CURVE, True), (EVEN_CURVE, True)]
    editor.follow(EVEN_CURVE)
    assert len(changes) == 3  # what follows the edit is no change


@pytest.mark.parametrize(("count", "points"), [(2, 2), (MOST_POINTS + 1, 0)])
def test_a_curve_of_a_file_may_have_other_points(client: Client, count: int, points: int) -> None:
    shown = Controls(client)
    editor = CurveEditor(lambda *change: None)
    editor.follow(tuple(i / (count - 1) for i in range(count))[::-1])
    assert len(shown.of(ui.slider)) == points
    drawn = [html.content for html in shown.of(ui.html)]
    assert any('points="0.0,0.0 ' in content and " 100.0,100.0" in content for content in drawn)  # falls
    editor.draw_tones("<svg></svg>")
    assert "<svg></svg>" in [html.content for html in shown.of(ui.html)]
