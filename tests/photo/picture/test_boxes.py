"""Boxes around objects: the pixels they hold, other sizes of a picture, and scribbles that they must hold."""

import pytest
import torch

from nlfilter_torch.photo.picture.boxes import boxes_of, check_scribbles_in, in_boxes, scaled
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.pixels import strips_of
from tests.problems import box, noise

SIZE = (12, 20)


def test_a_tuple_is_a_box_of_every_region_and_a_tensor_has_one_for_each() -> None:
    alone = boxes_of((2, 3, 10, 11.5), SIZE, 2, 3)
    assert alone.shape == (2, 3, 4)
    assert alone[1, 2].tolist() == [2, 3, 10, 11.5]
    each = torch.tensor([[[0, 0, 20, 12], [1, 1, 2, 2]]])
    torch.testing.assert_close(boxes_of(each, SIZE, 1, 2), each.float())
    assert boxes_of(each, SIZE, 1, None).shape == (1, 2, 4)
    torch.testing.assert_close(boxes_of(each[0, 0], SIZE, 1, None), each[:, :1].float())


def test_pixels_whose_centre_lies_in_a_box_are_held_in_every_part_of_a_picture() -> None:
    boxes = boxes_of((2.4, 3.0, 10.0, 11.5), SIZE, 1, None)
    image = InMemory(noise(1, 3, *SIZE))
    held = in_boxes(boxes, image)
    wanted = torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    wanted[..., 3:11, 2:10] = True
    assert torch.equal(held, wanted)
    rows = InMemory(image.image[..., 4:, :])
    rows.first = 4 * SIZE[1]
    assert torch.equal(in_boxes(boxes, rows), wanted[..., 4:, :])
    assert len(strips_of(image)) == 1


def test_boxes_follow_the_size_of_a_picture_and_hold_a_pixel_in_any() -> None:
    boxes = torch.tensor([[[2.0, 3.0, 10.0, 12.0], [19.0, 11.0, 20.0, 12.0]]])
    torch.testing.assert_close(scaled(boxes, SIZE, (24, 40)), 2 * boxes)
    small = scaled(boxes, SIZE, (3, 5))
    torch.testing.assert_close(small[:, 0], boxes[:, 0] / 4)
    assert small[0, 1].tolist() == [4, 2, 5, 3]
    assert in_boxes(small, InMemory(noise(1, 1, 3, 5))).flatten(2).any(2).all()
    assert boxes_of(small, (3, 5), 1, 2).shape == (1, 2, 4)


@pytest.mark.parametrize(("left", "held"), [(2, True), (8, True), (9, False)])
def test_a_stroke_may_cross_the_edge_of_its_box(left: int, held: bool) -> None:
    image, boxes = InMemory(noise(1, 3, *SIZE)), boxes_of((2.0, 2.0, 10.0, 10.0), SIZE, 1, None)
    stroke = image.scribbles(box(4, left, 3, 4, size=SIZE), None, "strokes")
    if held:
        check_scribbles_in(boxes, [stroke], SIZE, "strokes")
    else:
        with pytest.raises(ValueError, match=r"^box must hold most of the strokes on its object in every image, got"):
            check_scribbles_in(boxes, [stroke], SIZE, "strokes")
