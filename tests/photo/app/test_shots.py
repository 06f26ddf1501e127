"""A photograph that can be opened, its thumbnail, and the edit that another one gives it."""

from pathlib import Path

import pytest

from nlfilter_torch.photo.app.library import Library
from nlfilter_torch.photo.app.shots import Thumbnail, carried, free_name
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from tests.problems import cat


def test_an_edit_is_carried_without_what_belongs_to_a_photograph() -> None:
    mark = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "#2040e0")
    painted = Step("recolor", (mark,))
    given = Recipe((Step("tone", contrast=1.2), painted), Development(exposure=1.0, crop=(0.1, 0.1, 0.9, 0.9)))
    own = Recipe((Step("tone", contrast=0.8), painted), Development(exposure=-1.0, rotate=90))
    assert carried(given, own) == Recipe((Step("tone", contrast=1.2), painted), Development(exposure=1.0, rotate=90))
    region = Step("detail", (Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in"),), inside=(2.0, 1.0, 1.0, 1.0))
    (step,) = carried(Recipe((region,)), Recipe()).steps
    assert not step.has_region()


@pytest.mark.parametrize("name", ["large.jpg", "large.png"])
def test_a_thumbnail_is_small_and_knows_the_size(tmp_path: Path, name: str) -> None:
    image = resize(cat(), (300, 450)).clamp(0, 1)
    write_photograph(Photograph(image), tmp_path / name)
    thumbnail = Thumbnail.of(Library(tmp_path).shot(tmp_path / name))
    assert thumbnail.size == (300, 450)
    assert thumbnail.pixels.shape == (1, 3, 107, 160)
    assert (thumbnail.pixels - resize(image, (107, 160))).abs().mean() < 4 / 255


def test_a_free_name(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    (tmp_path / "a-2.png").touch()
    assert [free_name(lambda name: tmp_path / name, name) for name in ("a.png", "b.png")] == ["a-3.png", "b.png"]
