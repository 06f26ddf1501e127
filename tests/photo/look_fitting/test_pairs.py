"""Pairs of photographs that cannot be one are refused."""

import pytest
import torch

from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.look_fitting.pairs import images_of
from tests.looks import CAT, CUP, FEW


def test_batches_and_grey_photographs_are_images_in_colour() -> None:
    batch = torch.cat([CAT, CAT.flip(3)]).mean(1, keepdim=True)
    masks = torch.ones_like(batch).expand(-1, 2, -1, -1)
    images = list(images_of([(batch, batch**0.5, masks), (CAT, CAT**0.5)]))
    assert [tuple(before.shape) for before, _, _ in images] == [tuple(CAT.shape[1:])] * 3
    assert [None if masks is None else len(masks) for _, _, masks in images] == [2, 2, None]
    assert torch.equal(images[1][1], batch[1].expand(3, -1, -1) ** 0.5)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([], "pairs must hold a pair"),
        ([(CAT, CAT)], "each is the same before and after"),
        ([(CAT, torch.zeros_like(CAT))], "not clipped to black or white"),
        ([(CAT, CUP.flip(2, 3))], "must be an edit of before of pair 1"),
        ([(CAT, CAT[..., :50])], "after of pair 1"),
        ([CAT], "pairs must hold tuples"),
        ([(CAT, CAT**0.5, torch.zeros_like(CAT))], "masks must hold a pixel"),
        ([(CAT, CAT.to("meta"))], "after of pair 1 must be on the device of the before of pair 1, cpu, got meta; move"),
        ([(CAT, CAT**0.5), (CAT.to("meta"), CAT.to("meta"))], "before of pair 2 must be on the device of the first"),
        ([(CAT, CAT**0.5, CAT[:, :1].to("meta"))], "masks must be on the device of the before of pair 1, cpu, got"),
    ],
)
def test_bad_pairs_are_refused_in_a_sentence(pairs: list[object], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as error:
        fit_look(pairs, step=FEW)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
