"""Which scribbles are a trimap."""

import torch

from nlfilter_torch.photo.selections.trimap import trimap_share


def test_scribbles_that_leave_little_open_are_a_trimap() -> None:
    inside, outside = torch.zeros(3, 10, 10), torch.zeros(3, 10, 10)
    inside[0, :2], outside[0, -1:] = 1, 1
    inside[1, :3], outside[1, -4:] = 0.5, 1
    inside[2] = 1  # no side to tell it from
    shares = trimap_share(torch.stack([inside, outside], dim=1).flatten(2))
    assert shares.tolist() == [0, 1, 0]
