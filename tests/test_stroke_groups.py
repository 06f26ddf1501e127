"""Groups of strokes, and predictions of each from the others."""

import pytest
import torch
from torch import Tensor

from nlfilter_torch import colorize
from nlfilter_torch.photo.edits.colorize import (
    FEW_STROKES,
    MOST_WEIGHT,
    SAME_ERROR,
    Stage,
    colorize_guide,
    compared,
    extended,
)
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Guide, Operator, luminance
from nlfilter_torch.photo.selections.local_values import ABSOLUTE, RELATIVE, Links, LocalValues
from nlfilter_torch.photo.selections.stroke_groups import GROUPS, StrokeGroups
from tests.problems import box

SIZE = (20, 30)


def groups_of(mask: Tensor) -> tuple[StrokeGroups, Tensor]:
    """Groups of the strokes of a mask (B, 1, H, W), and their places."""
    places = mask.amax((0, 1)).flatten().nonzero().squeeze(1)
    scribbles = Scribbles(places, mask.flatten(2)[:, :, places], torch.zeros(1, 1, len(places)))
    return StrokeGroups.of(scribbles, (mask.shape[2], mask.shape[3])), places


def dots(*positions: tuple[int, int], size: tuple[int, int] = SIZE) -> Tensor:
    mask = torch.zeros(1, 1, *size)
    for row, column in positions:
        mask[..., row, column] = 1
    return mask


def test_strokes_are_connected_areas_of_each_image() -> None:
    first = box(2, 3, 4, 2, size=SIZE) + box(6, 5, 2, 6, size=SIZE)  # these touch at a corner
    mask = torch.cat([first + box(15, 20, 3, 3, size=SIZE), box(4, 8, 12, 1, size=SIZE)])
    groups, places = groups_of(mask)
    assert groups.count == 2
    painted = mask.flatten(2)[:, :, places]
    assert torch.equal(groups.strokes[0][painted[0, 0] > 0], (places >= 15 * 30).long()[painted[0, 0] > 0])
    assert groups.sums(painted).squeeze(1).tolist() == [[20, 9], [12, 0]]


def test_in_large_pictures_areas_close_together_are_one_stroke() -> None:
    size = (640, 640)
    first = box(10, 10, 4, 4, size=size)
    assert groups_of(first + box(10, 15, 4, 4, size=size))[0].count == 1
    assert groups_of(first + box(10, 40, 4, 4, size=size))[0].count == 2


def test_each_group_is_left_out_once() -> None:
    mask = dots(*((3 * (k // 4) + 1, 6 * (k % 4) + 2) for k in range(12)))
    groups, _ = groups_of(mask)
    values = torch.rand(2, 3, 12, generator=torch.Generator().manual_seed(0)) + 0.1
    sets = groups.without_each(values)
    assert len(sets) == GROUPS
    torch.testing.assert_close(sum(sets), (GROUPS - 1) * values)  # type: ignore[arg-type]
    assert not groups.of_own(sets).any()
    torch.testing.assert_close(
        groups.of_own([values * k for k in range(GROUPS)]), values * (groups.strokes % GROUPS)[:, None]
    )


def test_a_single_stroke_is_not_left_out_nor_are_all_strokes_of_an_image() -> None:
    assert not groups_of(box(2, 3, 4, 2, size=SIZE))[0].without_each(torch.ones(1, 1, 8))
    mask = torch.cat([dots((2, 3), (9, 20)), dots((9, 20))])
    groups, places = groups_of(mask)
    weights = mask.flatten(2)[:, :, places]
    first, second = groups.weights_without_each(weights)
    assert first.squeeze(1).tolist() == [[0, 1], [0, 1]]
    assert second.squeeze(1).tolist() == [[1, 0], [0, 1]]


@pytest.mark.parametrize("links", [ABSOLUTE, RELATIVE], ids=["absolute", "relative"])
def test_neighbours_predict_a_dot_as_if_it_were_not_painted(links: Links) -> None:
    image = torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(1)) * 0.02 + 0.3
    mask = dots((3, 4), (10, 25), (16, 12), (5, 17))
    values = torch.rand(1, 2, *SIZE, generator=torch.Generator().manual_seed(2))
    groups, places = groups_of(mask)
    weights, known = torch.ones(1, 1, 4), values.flatten(2)[:, :, places]
    found = LocalValues.of(links, image, SIZE, places, weights, known, groups, known)
    assert found.left_out is not None
    ratio = found.left_out[:, :-1] / found.left_out[:, -1:]
    for k in range(4):
        rest = torch.arange(4) != k
        without = LocalValues.of(links, image, SIZE, places[rest], weights[..., rest], known[..., rest])
        wanted = without(image, 0)[:, :-1].flatten(2)[:, :, places[k]]
        torch.testing.assert_close(ratio[:, :, k].float(), wanted, rtol=1e-4, atol=1e-5)


def test_neither_estimate_predicts_a_stroke_from_itself() -> None:
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(1, 1, *SIZE, generator=generator)
    mask = box(2, 3, 3, 3, size=SIZE) + box(12, 20, 3, 3, size=SIZE) + box(4, 16, 3, 3, size=SIZE)
    groups, places = groups_of(mask)
    weights, source = torch.ones(1, 1, len(places)), InMemory(image)

    def operator_of(stage: Stage) -> Operator:
        scale = {"photometric_bandwidth": 0.2 * stage.photometric, "spatial_bandwidth": 9 * stage.spatial}
        return source.operator(Guide({"num_landmarks": 30, "patch_size": 1, **scale}, colorize_guide, spectral=True))

    def predictions(values: Tensor) -> tuple[Tensor, Tensor]:
        sets = [weights, *groups.weights_without_each(weights)]
        (far, near), residuals = extended(operator_of, places, sets, values, SIZE[0] * SIZE[1], 1.0)
        whole = (far(source) + near(source))[:, :2].flatten(2)[:, :, places]
        torch.testing.assert_close(values - residuals[0], whole, rtol=1e-4, atol=1e-5)
        guide = source.reduced(luminance, 1)
        local = LocalValues.of(RELATIVE, guide, SIZE, places, weights, values, groups, values).left_out
        assert local is not None
        return values - groups.of_own(residuals[1:]), (local[:, :2] / local[:, 2:]).to(values)

    values = torch.rand(1, 2, len(places), generator=generator)
    changed = torch.where(groups.strokes[0] == 1, values + 0.5, values)
    for before, after in zip(predictions(values), predictions(changed), strict=True):
        torch.testing.assert_close(before[:, :, groups.strokes[0] == 1], after[:, :, groups.strokes[0] == 1])
        assert (before - after)[:, :, groups.strokes[0] != 1].abs().max() > 1e-3


def test_the_regression_counts_more_if_it_predicts_strokes_better_and_if_there_are_more_of_them() -> None:
    mask = torch.cat([dots((2, 3), (9, 20), (15, 8))] * 2 + [dots((2, 3))])
    groups, places = groups_of(mask)
    weights, wanted = mask.flatten(2)[:, :, places], torch.zeros(3, 2, 3)
    flow = torch.full((3, 3, 3), 0.5, dtype=torch.float64)
    flow[:, :2] *= SAME_ERROR**0.5  # all predictions are off by this
    flow[2] = 0  # a single stroke: nothing is compared
    residual = torch.full((3, 2, 3), SAME_ERROR**0.5)
    residual[1] = 0.0
    factors = compared(groups, weights, residual, wanted, flow).flatten()
    few, none = 4 / (4 + FEW_STROKES), 1 / (1 + FEW_STROKES)  # for three strokes and for no comparison
    torch.testing.assert_close(factors, torch.tensor([few, MOST_WEIGHT * few, none]))
    assert compared(groups, weights, residual * 9, wanted, flow)[0] < 0.01


def test_colours_do_not_depend_on_other_images_of_a_batch() -> None:
    image = torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(4))
    mask = torch.cat([dots((2, 3), (9, 20), (15, 8), (4, 24), (10, 9)), dots((3, 3), (9, 21))])
    grey = image.mean(1, keepdim=True)
    both = colorize(grey, image, mask, num_landmarks=30)
    for k in range(2):
        alone = colorize(grey[k : k + 1], image[k : k + 1], mask[k : k + 1], num_landmarks=30)
        torch.testing.assert_close(both[k : k + 1], alone, atol=1e-4, rtol=0)
