"""The editor's preview: what it shows is what is saved, and what does not change is not worked out again."""

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch import diffusion_mask, estimate_bandwidth, nonlocal_operator, polynomial_filter
from nlfilter_torch.app.preview import MaskMaker, Preview, reduce, sampled_operator, stride_for
from nlfilter_torch.app.session import Session
from nlfilter_torch.brush import Stroke
from nlfilter_torch.features import reduce_channels
from nlfilter_torch.recipe import Recipe
from nlfilter_torch.steps import Abstract, Defocus, Detail
from tests.problems import cat, difference


def test_preview_of_a_small_photograph_is_the_photograph(session: Session) -> None:
    assert session.preview.stride == 1
    assert torch.equal(session.preview.pixels, cat())


@pytest.mark.parametrize("colour", [True, False])
def test_what_is_shown_is_what_is_saved(colour: bool) -> None:
    image = cat() if colour else reduce_channels(cat(), "luminance")
    region = Stroke(((0.2, 0.2), (0.3, 0.2)), 0.04, "in")
    outside = Stroke(((0.8, 0.8),), 0.04, "out")
    preview = Preview(image)
    for recipe in (
        Recipe(),
        Recipe(Detail((3.0, 2.0, 1.0))),
        Recipe(Detail((3.0, 3.0, 4.0, 1.05), bandwidth=15.0, spatial_bandwidth=20.0, patch_size=3, landmarks=40)),
        Recipe(Detail((0.2, 1.0, 1.0, 1.0), (3.0, 3.0, 4.0, 1.0), 0.5, (region, outside))),
        Recipe(Detail((2.0, 1.0, 1.0, 1.0)), defocus=Defocus((region,))),
    ):
        assert difference(preview.render(recipe), recipe.apply(image)) < 1


def test_steps_are_held_until_one_before_them_changes(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    work = Abstract.apply
    monkeypatch.setattr(Abstract, "apply", lambda step, image: calls.append(step) or work(step, image))
    session.set("abstract", power=0.1)
    first = session.render()
    assert torch.equal(session.render(), first)
    assert len(calls) == 1
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    assert not torch.equal(session.render(), first)
    assert len(calls) == 2
    assert torch.equal(session.render("detail"), Preview(cat()).render(Recipe(session.recipe.detail)))
    assert len(calls) == 2


def test_a_slider_moves_without_the_operator(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    session.set("detail", alpha=(3.0, 1.0, 1.0, 1.0))
    session.render()
    monkeypatch.setattr("nlfilter_torch.app.preview.sampled_operator", None)
    session.set("detail", alpha=(2.0, 1.0, 1.0, 1.0))
    assert difference(session.render(), session.recipe.apply(cat())) < 1
    session.set("detail", bandwidth=12.0)
    with pytest.raises(TypeError):
        session.render()


def test_stride_keeps_a_preview_small() -> None:
    for height, width in ((1000, 1000), (1001, 1000), (4000, 6000), (1, 3_000_001)):
        stride = stride_for(height, width)
        assert (height // stride) * (width // stride) <= 1_000_000
    assert stride_for(4000, 6000) == 5


def test_sampled_operator_is_a_sample_of_the_whole() -> None:
    image = reduce_channels(cat(1), "luminance")  # 300x450
    bandwidth = float(estimate_bandwidth(image))
    alpha = torch.tensor([3.0, 3.0, 4.0, 1.05])
    whole = polynomial_filter(nonlocal_operator(image, photometric_bandwidth=bandwidth), image, alpha)
    for stride in (1, 2, 3):
        first = (stride - 1) // 2
        operator = sampled_operator(image, stride, Detail(), bandwidth=bandwidth, channels="luminance", patch_size=5)
        height, width = operator.size
        assert operator.size == (300 // stride, 450 // stride)
        points = image[..., first::stride, first::stride][..., :height, :width]
        found = polynomial_filter(operator, points, alpha)
        wanted = whole[..., first::stride, first::stride][..., :height, :width]
        assert (found - wanted).square().mean().sqrt() * 255 < 1.0
        assert (wanted - points).square().mean().sqrt() * 255 > 15


def test_sampled_operator_in_colour_and_nearby() -> None:
    """As close as the whole operator is with other landmarks; half or twice the spatial bandwidth is 2.4 levels off."""
    image = cat(1)
    options = {"patch_size": 3, "photometric_bandwidth": 0.1, "spatial_bandwidth": 60.0, "num_landmarks": 200}
    whole = nonlocal_operator(image, guide_channels="all", **options) @ image  # type: ignore[arg-type]
    detail = Detail(landmarks=200, spatial_bandwidth=60.0, patch_size=3)
    operator = sampled_operator(image, 2, detail, bandwidth=0.1, channels="all", patch_size=3)
    found, wanted = operator @ image[..., ::2, ::2], whole[..., ::2, ::2]
    assert (found - wanted).square().mean().sqrt() * 255 < 0.8


def test_preview_of_a_large_photograph_shows_what_saving_gives() -> None:
    """A preview that filtered the reduced picture would be twice as far off."""
    image = cat(1)
    recipe = Recipe(Detail((3.0, 3.0, 4.0, 1.05)))
    preview = Preview(image, pixels=40_000)
    assert preview.stride == 2
    wanted = reduce(recipe.apply(image).clamp(0, 1), 2)

    def error(found: torch.Tensor) -> float:
        return float((found - wanted).square().mean().sqrt()) * 255

    assert error(preview.render(recipe)) < error(recipe.apply(preview.pixels).clamp(0, 1)) / 2


def test_masks_are_those_of_the_library() -> None:
    image = cat()
    spectrum = nonlocal_operator(image, photometric_bandwidth=25 / 255, guide_channels="all").spectrum()
    maker = MaskMaker(spectrum, ())
    first, second = torch.zeros(2, 1, 1, 100, 150).unbind()
    first[..., 20:25, 30:40], second[..., 80:90, 5:9] = 1, 1
    for region, negative, time in ((first, None, 1.0), (second, None, 1.0), (first, second, 1.0), (first, None, 0.3)):
        wanted = diffusion_mask(spectrum, region, time=time, negative=negative)
        assert (maker.mask(region, negative, time) - wanted).abs().max() < 2e-3


def test_areas_are_means() -> None:
    image = cat(1)
    assert reduce(image, 1) is image
    assert torch.allclose(reduce(image, 3), F.interpolate(image, scale_factor=1 / 3, mode="area"), atol=1e-6)
