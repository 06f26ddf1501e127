"""The frame of the crop, and its proportions, without a browser."""

from nicegui import Client

from nlfilter_torch.photo.app.tools import Brush, CropTool, Proportions
from nlfilter_torch.photo.declared.strokes import Region, Stroke


def test_the_tool_tells_the_page_what_to_show(client: Client, scripts: list[str]) -> None:
    tool = CropTool()
    handles = [e for e in client.elements.values() if e.props.get("role") == "slider"]
    assert [e.props["aria-label"] for e in handles] == ["Left edge", "Top edge", "Right edge", "Bottom edge"]
    tool.show("/picture/token/whole?1", (100, 150), (0.1, 0.0, 1.0, 0.5), 1.5)
    assert scripts.pop() == "cropper.show('/picture/token/whole?1', 150, 100, [0.1, 0.0, 1.0, 0.5], 1.5)"
    tool.hide()
    assert scripts == ["cropper.hide()"]


def test_a_box_goes_from_where_a_drag_begins_to_where_it_ends() -> None:
    brush = Brush()
    assert brush.mark("defocus", [(0.1, 0.2), (0.3, 0.4)]) == Stroke(((0.1, 0.2), (0.3, 0.4)), 0.02, "in")
    brush.word["defocus"], brush.word["recolor"] = "box", "box colour"
    box = brush.mark("defocus", [(0.5, 0.75), (0.9, 0.9), (0.25, 0.25)])
    assert box == Region.upright((0.25, 0.25, 0.25, 0.5), "rectangle", "box")
    assert brush.drags("recolor") == "rectangle"
    assert brush.mark("recolor", [(0.0, 0.0), (0.5, 0.5)]).colour == brush.colour


def test_a_gradient_goes_from_one_point_to_another() -> None:
    brush = Brush()
    for word, shape in (("linear: add colour", "linear"), ("radial: add colour", "radial")):
        brush.word["recolor"] = word
        assert brush.drags("recolor") == shape
        mark = brush.mark("recolor", [(0.5, 0.75), (0.9, 0.9), (0.25, 0.25)])
        assert mark == Region.dragged((0.5, 0.75), (0.25, 0.25), shape, f"add {brush.colour}")


def test_proportions_are_cut_from_what_a_person_has_made() -> None:
    mine, other = (0.1, 0.0, 0.9, 1.0), (0.2, 0.2, 0.7, 0.7)
    proportions = Proportions("3:2")
    assert proportions.begin(mine) == mine
    proportions.cut = other
    assert proportions.begin(other) == mine  # so that it does not shrink from one choice to the next
    assert proportions.begin((0.3, 0.2, 0.7, 0.7)) == (0.3, 0.2, 0.7, 0.7)
    proportions.kept = frozenset({mine})
    proportions.follow(mine)
    assert proportions.name == "3:2"
    proportions.follow(other)
    assert proportions.name == "Free"
    assert Proportions("3:4").aspect((100, 150)) == 0.75
