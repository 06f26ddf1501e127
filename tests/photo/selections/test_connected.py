"""What is connected with a scribble, and masks of it."""

import numpy as np
import pytest
import torch
from skimage.measure import label

from nlfilter_torch.photo import defocus, enhance, recolor, region_mask
from nlfilter_torch.photo.selections.connected import SOFT_BORDER, connected, connected_pieces, without_haze
from tests.problems import box, inverse, noise, oriented, paint
from tests.strokes import SIZE as DOTTED
from tests.strokes import dots, groups_of

SIZE = (48, 64)
LEFT, RIGHT, FAR = (box(*corner, 12, 12, size=SIZE) for corner in ((18, 4), (18, 26), (18, 50)))
STROKE = box(22, 8, 4, 4, size=SIZE)


def scene() -> torch.Tensor:
    """Three reddish squares with grain in a row on a bluish ground."""
    inside = LEFT + RIGHT + FAR
    image = 0.1 * noise(1, 3, *SIZE, dtype=torch.float32) + 0.2
    image[:, :1] += 0.5 * inside
    image[:, 2:] += 0.4 * (1 - inside)
    return image


def covered(mask: torch.Tensor, part: torch.Tensor) -> float:
    return float((mask * part).sum() / part.sum())


def test_only_what_is_connected_belongs_to_the_object() -> None:
    masks = (LEFT + RIGHT).clamp(max=1) + 0.1 * box(10, 2, 30, 60, size=SIZE)
    belongs = connected(masks.clamp(max=1), STROKE)
    assert belongs[LEFT > 0].all()
    assert not belongs[RIGHT > 0].any()
    assert belongs[..., 17, 10]  # its border
    assert not belongs[..., 17 - SOFT_BORDER - 1, 10]
    both = connected(masks.clamp(max=1), STROKE + box(20, 30, 2, 2, size=SIZE))
    assert both[LEFT + RIGHT > 0].all()
    fragment = box(15, 10, 1, 2, size=SIZE)  # such as hair beside it
    assert connected(torch.maximum(masks, fragment).clamp(max=1), STROKE)[fragment > 0].all()
    touching = torch.maximum(masks, box(20, 10, 2, 20, size=SIZE)).clamp(max=1)
    assert connected(touching, STROKE)[RIGHT > 0].all()
    assert not connected(0 * masks, 0 * STROKE).any()
    assert connected(0 * masks, STROKE)[STROKE > 0].all()
    for number in range(8):
        turned = connected(oriented(masks.clamp(max=1), number), oriented(STROKE, number))
        assert torch.equal(inverse(turned.float(), number) > 0, belongs)


def test_haze_and_specks_smaller_than_the_scribbles_go_away_from_what_is_selected() -> None:
    speck, large, hair = box(5, 50, 3, 3, size=SIZE), box(40, 40, 5, 6, size=SIZE), box(15, 10, 1, 2, size=SIZE)
    shade, haze = 0.2 * box(0, 20, 48, 10, size=SIZE), 0.04 * torch.ones_like(speck)
    masks = torch.stack([LEFT + speck + large + hair, shade, haze]).amax(0).clamp(max=1)
    stays = without_haze(masks, STROKE, STROKE.sum((2, 3)))
    assert (stays[LEFT + large + hair > 0] == 1).all()
    assert (stays[..., 0:9, 20:30] == 1).all()
    assert not stays[..., 1:12, 46:58].any()  # the speck with its soft border
    assert not stays[..., 0:9, 34:40].any()  # haze
    assert (stays[..., 14:34, 4:20] == 1).all()  # the border of the object
    assert (without_haze(masks, STROKE, 0 * STROKE.sum((2, 3)))[speck > 0] == 1).all()  # no speck is too small
    half = without_haze(0.075 * torch.ones_like(masks), STROKE, STROKE.sum((2, 3)))
    assert half[..., 40, 60] == pytest.approx(0.5)
    for number in range(8):
        turned = without_haze(oriented(masks, number), oriented(STROKE, number), STROKE.sum((2, 3)))
        assert torch.equal(inverse(turned, number), stays)


def test_each_region_is_connected_by_itself() -> None:
    masks = torch.cat([LEFT + FAR, RIGHT + FAR], dim=1).expand(2, -1, -1, -1)
    strokes = torch.cat([STROKE, box(20, 30, 2, 2, size=SIZE)], dim=1).expand(2, -1, -1, -1)
    belongs = connected(masks, strokes)
    assert belongs[:, :1][(LEFT > 0).expand(2, -1, -1, -1)].all()
    assert belongs[:, 1:][(RIGHT > 0).expand(2, -1, -1, -1)].all()
    assert not belongs[(FAR > 0).expand(2, 2, -1, -1)].any()


def test_masks_of_the_object_of_what_is_near_and_of_everything() -> None:
    image = scene()
    near, this, everywhere = (
        region_mask(image, STROKE, extent=extent, spatial_bandwidth=24.0, num_landmarks=60)
        for extent in ("near", "object", "everywhere")
    )
    assert torch.equal(this, region_mask(image, STROKE, spatial_bandwidth=24.0, num_landmarks=60))
    assert min(covered(mask, LEFT) for mask in (near, this, everywhere)) > 0.9
    assert covered(near, RIGHT) > 0.5
    assert covered(this, RIGHT) == covered(this, FAR) == 0
    assert covered(everywhere, FAR) > 0.9
    with pytest.raises(ValueError, match="extent must be one of 'near', 'object', 'everywhere', got 'here'"):
        region_mask(image, STROKE, extent="here")  # type: ignore[arg-type]


def test_every_edit_of_objects_stops_at_the_object() -> None:
    image = scene()
    painted = paint(0.1, 0.7, 0.2, STROKE)
    sliders = torch.tensor([4.0, 4.0, 1.0])
    sharp = defocus(image, STROKE, radius=2.0, num_landmarks=60, extent="object")
    assert (sharp - image)[(RIGHT > 0).expand_as(image)].abs().max() > 1e-3
    for edited in (
        recolor(image, painted, STROKE, num_landmarks=60, extent="object"),
        enhance(image, sliders, STROKE, num_landmarks=60, extent="object"),
    ):
        change = (edited - image).abs().amax(1, keepdim=True)
        assert change[LEFT > 0].max() > 1e-3
        assert change[RIGHT > 0].max() == 0


def test_strokes_are_connected_areas_of_each_image() -> None:
    first = box(2, 3, 4, 2, size=DOTTED) + box(6, 5, 2, 6, size=DOTTED)  # these touch at a corner
    mask = torch.cat([first + box(15, 20, 3, 3, size=DOTTED), box(4, 8, 12, 1, size=DOTTED)])
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
    assert not groups_of(box(2, 3, 4, 2, size=DOTTED))[0].without_each(torch.ones(1, 1, 8))
    mask = torch.cat([dots((2, 3), (9, 20)), dots((9, 20))])
    groups, places = groups_of(mask)
    weights = mask.flatten(2)[:, :, places]
    first, second = groups.weights_without_each(weights)
    assert first.squeeze(1).tolist() == [[0, 1], [0, 1]]
    assert second.squeeze(1).tolist() == [[1, 0], [0, 1]]


def test_pieces_of_places_are_those_of_the_picture() -> None:
    """Pixels at the end of a row and at the beginning of the next are not connected."""
    painted = (noise(1, 1, 17, 23) > 0.3).numpy()[0, 0]
    pieces = connected_pieces(np.flatnonzero(painted), 23)
    assert (pieces + 1 == label(painted, connectivity=2)[painted]).all()
