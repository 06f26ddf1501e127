"""The frame of the crop over the whole photograph, which ``static/crop.js`` lets a person drag."""

import json
from collections.abc import Sequence

from nicegui import ui

EDGES = ("left", "top", "right", "bottom")
CORNERS = ("top left", "top right", "bottom right", "bottom left")


class CropTool:
    """The photograph without a crop, and the frame of the crop over it, built into the open element."""

    def __init__(self) -> None:
        with ui.element("div").classes("cropper") as self._tool, ui.element("div").classes("crop-picture"):
            ui.element("img").classes("uncropped").props('alt="the whole photograph"')
            with ui.element("div").classes("crop-frame").props('role="group" aria-label="Crop"'):
                for corner in CORNERS:
                    ui.element("div").classes(f"crop-corner {corner}").props('aria-hidden="true"')
                for edge in EDGES:
                    handle = ui.element("div").classes(f"crop-edge {edge}").props('role="slider" tabindex="0"')
                    handle.props(f'aria-label="{edge.capitalize()} edge" aria-valuemin="0" aria-valuemax="100"')
                    handle.props(f'aria-valuenow="0" data-edge="{edge}"')
        self._tool.set_visibility(False)

    def show(self, address: str, size: tuple[int, int], edges: Sequence[float]) -> None:
        """Show the picture at an address, (height, width) in size, and a frame."""
        self._tool.set_visibility(True)
        ui.run_javascript(f"cropper.show('{address}', {size[1]}, {size[0]}, {json.dumps(list(edges))})")

    def hide(self) -> None:
        """Hide it."""
        self._tool.set_visibility(False)
        ui.run_javascript("cropper.hide()")
