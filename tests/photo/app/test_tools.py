"""The frame of the crop, and its proportions, without a browser."""

from nicegui import Client

from nlfilter_torch.photo.app.tools import CropTool, Proportions


def test_the_tool_tells_the_page_what_to_show(client: Client, scripts: list[str]) -> None:
    tool = CropTool()
    handles = [e for e in client.elements.values() if e.props.get("role") == "slider"]
    assert [e.props["aria-label"] for e in handles] == ["Left edge", "Top edge", "Right edge", "Bottom edge"]
    tool.show("/picture/token/whole?1", (100, 150), (0.1, 0.0, 1.0, 0.5), 1.5)
    assert scripts.pop() == "cropper.show('/picture/token/whole?1', 150, 100, [0.1, 0.0, 1.0, 0.5], 1.5)"
    tool.hide()
    assert scripts == ["cropper.hide()"]


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
