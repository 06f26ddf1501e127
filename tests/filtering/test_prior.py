"""The derivatives of the proximal maps, without the layer around them."""

import torch

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.filtering.prior import Kept, proximal_map
from tests.problems import noise


def test_the_matrix_of_a_weight_is_kept_until_another_is_asked_for() -> None:
    operator, image = nonlocal_operator(noise(1, 1, 8, 8), num_landmarks=9), noise(1, 1, 8, 8)
    kept: list[Kept] = []
    first = proximal_map(operator, image, 0.5, "red", kept)
    (entry,) = kept
    torch.testing.assert_close(proximal_map(operator, image, 0.5, "red", kept), first, atol=0, rtol=0)
    assert kept == [entry]
    assert not torch.allclose(proximal_map(operator, image, 0.5, "plug-and-play", kept), first)
    assert len(kept) == 1
    assert kept[0][3] is not entry[3]
