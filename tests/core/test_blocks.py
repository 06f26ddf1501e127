"""Blocks of pixels, batches folded into channels, and strips for several cores."""

import pytest
import torch

from nlfilter_torch import captured_energy, nonlocal_operator
from nlfilter_torch.core.blocks import mirrored, order_by, reflected, symmetric_places
from tests.problems import build, noise


def _filtered_and_gradients(threads: int) -> list[torch.Tensor]:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        guide = noise(1, 1, 12, 10).requires_grad_()
        operator = nonlocal_operator(guide, photometric_bandwidth=0.3, num_landmarks=15)
        filtered = operator @ noise(1, 2, 12, 10)
        energy = captured_energy(operator.spectrum(), filtered)
        return [filtered, energy, *torch.autograd.grad(filtered.square().sum() + energy.sum(), guide)]
    finally:
        torch.set_num_threads(before)


def test_one_guide_serves_a_batch_of_images_and_the_other_way_round() -> None:
    operator, image = build(noise(1, 1, 8, 9), num_landmarks=20), noise(3, 2, 8, 9)
    torch.testing.assert_close(operator @ image, torch.cat([operator @ image[i : i + 1] for i in range(3)]))
    several = build(noise(3, 1, 8, 9), num_landmarks=20)
    torch.testing.assert_close(several @ image[:1], several @ image[:1].expand(3, -1, -1, -1))


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_strips_of_pixels_for_several_cores_do_not_change_the_result(threads: int) -> None:
    for result, alone in zip(_filtered_and_gradients(threads), _filtered_and_gradients(1), strict=True):
        torch.testing.assert_close(result, alone, rtol=1e-9, atol=1e-9)


def test_values_are_ordered_by_others_where_they_are_equal() -> None:
    first, second = (
        torch.tensor([[2, 1, 2, 1], [0, 0, 0, 0]]),
        torch.tensor([[5.0, 3.0, 4.0, 6.0], [3.0, 2.0, 1.0, 0.0]]),
    )
    assert order_by(first, second).tolist() == [[1, 3, 2, 0], [3, 2, 1, 0]]


def test_places_beyond_an_axis_are_reflected() -> None:
    assert reflected(torch.arange(-3, 6), 3).tolist() == [1, 2, 1, 0, 1, 2, 1, 0, 1]
    assert reflected(torch.arange(-2, 3), 1).tolist() == [0] * 5


def test_a_place_is_mirrored_in_both_sides_and_in_a_square_in_its_diagonals() -> None:
    assert mirrored(torch.tensor([0]), torch.tensor([1]), (2, 5)).tolist() == [1, 3, 6, 8]
    assert mirrored(torch.tensor([0]), torch.tensor([1]), (5, 2)).sort().values.tolist() == [2, 3, 6, 7]
    assert mirrored(torch.tensor([0]), torch.tensor([1]), (3, 3)).unique().tolist() == [1, 3, 5, 7]


@pytest.mark.parametrize("size", [(7, 12), (9, 9), (1, 5), (1, 1)])
def test_symmetric_places_are_those_of_the_turned_image(size: tuple[int, int]) -> None:
    def drawn(turned: tuple[int, int]) -> torch.Tensor:
        count = symmetric_places(turned, 24, torch.Generator().manual_seed(0)).bincount(minlength=size[0] * size[1])
        return count.unflatten(0, turned)

    counts = drawn(size)
    for turned in (counts.flip(0), counts.flip(1), drawn((size[1], size[0])).mT):
        assert torch.equal(counts, turned)
