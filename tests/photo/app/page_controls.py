"""A stand-in for the page, for tests of the controls beside the picture."""

from collections.abc import Mapping

from nicegui import Client, ui

from nlfilter_torch.photo.app.brush import Brush
from nlfilter_torch.photo.app.tabs import EditTab, Link, PhotoLink
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.strokes import Stroke

IN = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")


class Controls:
    """What a page has for its controls; it records what they call."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.recipe = Recipe()
        self.brush = Brush()
        self.changes: list[tuple[str, Mapping[str, object], bool]] = []
        self.cleared: list[str] = []
        self.thumbnails: dict[str, str] = {}
        self.developed: list[object] = []
        self.is_cropping = self.is_picking = False
        self.held = "Free"
        self.replaced: list[tuple[Recipe, int | None]] = []
        self.link = Link(
            lambda: self.recipe,
            self.brush,
            lambda *change: self.changes.append(change),
            self.cleared.append,
            lambda *change: self.replaced.append(change),
            lambda look: self.thumbnails.get(look, ""),
            PhotoLink(
                lambda *change: self.developed.append(change),
                lambda: self.developed.append("crop"),
                lambda: self.is_cropping,
                self.hold,
                lambda: self.held,
                lambda: self.developed.append("pick"),
                lambda: self.is_picking,
            ),
        )

    def hold(self, proportions: str) -> None:
        """Let the crop keep proportions."""
        self.held = proportions
        self.developed.append(proportions)

    def show(self, tab: EditTab, recipe: Recipe) -> None:
        """Let a tab show an edit."""
        self.recipe = recipe
        tab.follow()

    def of(self, kind: type[ui.element]) -> list[ui.element]:
        """The elements of a kind."""
        return [element for element in self.client.elements.values() if isinstance(element, kind)]

    def texts(self) -> list[str]:
        """The texts of all labels."""
        return [element.text for element in self.client.elements.values() if isinstance(element, ui.label)]

    def sliders(self) -> dict[str, float]:
        """Values of the sliders by their labels for screen readers."""
        return {slider.props["aria-label"]: slider.value for slider in self.of(ui.slider)}

    def click(self, label: str) -> None:
        """Click a button by its text or by its label for screen readers."""
        (button,) = [b for b in self.of(ui.button) if label in (b.text, b.props.get("aria-label"))]
        for listener in button._event_listeners.values():
            if listener.type == "click":
                listener.handler(None)
