"""A stand-in for the page, for tests of the controls beside the picture."""

from collections.abc import Mapping

from nicegui import Client, ui

from nlfilter_torch.photo.app.tabs import EditTab
from nlfilter_torch.photo.app.tools import Brush, Proportions
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.strokes import Stroke

IN = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")


class Controls:
    """What a page has for its controls; it records what they call."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.edit = Recipe()
        self.brush, self.proportions = Brush(), Proportions()
        self.changes: list[tuple[str, Mapping[str, object], bool]] = []
        self.cleared: list[str] = []
        self.cut: list[str] = []
        self.thumbnails: dict[str, str] = {}
        self.developed: list[object] = []
        self.is_cropping = self.is_picking = False
        self.replaced: list[tuple[Recipe, int | None]] = []

    def recipe(self) -> Recipe:
        """The current edit."""
        return self.edit

    def change(self, step: str, values: Mapping[str, Value], complete: bool) -> None:
        """Change a step."""
        self.changes.append((step, values, complete))

    def clear(self, step: str) -> None:
        """Remove the strokes of a step."""
        self.cleared.append(step)

    def cut_out(self, step: str) -> None:
        """Cut out the object of a step."""
        self.cut.append(step)

    def replace(self, recipe: Recipe, moving: int | None) -> None:
        """Replace the edit."""
        self.replaced.append((recipe, moving))

    def thumbnail(self, look: str) -> str:
        """The address of a picture under a look."""
        return self.thumbnails.get(look, "")

    def develop(self, values: Mapping[str, Value], complete: bool) -> bool:
        """Change how the photograph is developed."""
        self.developed.append((values, complete))
        return True

    def toggle_crop(self) -> None:
        """Show or hide the frame of the crop."""
        self.developed.append("crop")

    def turn(self, quarters: int) -> None:
        """Turn the photograph."""
        self.developed.append(quarters)

    def toggle_pick(self) -> None:
        """Let the next click choose what is grey, or no longer."""
        self.developed.append("pick")

    def hold(self, name: str) -> None:
        """Let the crop keep proportions."""
        self.proportions.name = name
        self.developed.append(name)

    def show(self, tab: EditTab, recipe: Recipe) -> None:
        """Let a tab show an edit."""
        self.edit = recipe
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

    def pressed(self, label: str) -> bool:
        """Whether a button that switches something is pressed."""
        (button,) = [b for b in self.of(ui.button) if b.text == label]
        return bool(button.props["aria-pressed"] == "true")

    def button(self, label: str) -> ui.button:
        """A button by its text or by its label for screen readers."""
        (button,) = [b for b in self.of(ui.button) if label in (b.text, b.props.get("aria-label"))]
        return button

    def click(self, label: str) -> None:
        """Click a button."""
        for listener in self.button(label)._event_listeners.values():
            if listener.type == "click":
                listener.handler(None)
