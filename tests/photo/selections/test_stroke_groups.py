"""Groups of strokes, and values without those of a group."""

import torch

from tests.problems import box
from tests.strokes import SIZE, dots, groups_of


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
    assert len(sets) == 5
    torch.testing.assert_close(sum(sets), 4 * values)  # type: ignore[arg-type]
    assert not groups.of_own(sets).any()
    torch.testing.assert_close(groups.of_own([values * k for k in range(5)]), values * (groups.strokes % 5)[:, None])


def test_a_single_stroke_is_not_left_out_nor_are_all_strokes_of_an_image() -> None:
    assert not groups_of(box(2, 3, 4, 2, size=SIZE))[0].without_each(torch.ones(1, 1, 8))
    mask = torch.cat([dots((2, 3), (9, 20)), dots((9, 20))])
    groups, places = groups_of(mask)
    weights = mask.flatten(2)[:, :, places]
    first, second = groups.weights_without_each(weights)
    assert first.squeeze(1).tolist() == [[0, 1], [0, 1]]
    assert second.squeeze(1).tolist() == [[1, 0], [0, 1]]
