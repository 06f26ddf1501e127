"""Blocks of pixels, batches folded into channels, and strips for several cores."""

import pytest
import torch

from nlfilter_torch import captured_energy, nonlocal_operator
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
