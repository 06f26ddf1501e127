"""LookSums over pixels, the columns they are of, and the sample they are taken over."""

import pytest
import torch

from nlfilter_torch.photo.looks.look_filter import pointwise
from nlfilter_torch.photo.looks.look_sums import LookSums, PartLayout, columns_of, sample, sums_of
from tests.looks import BENT, CAT, SEPIA, VIVID


def test_sums_of_samples_are_those_of_all_pixels() -> None:
    generator = torch.Generator().manual_seed(0)
    whole = torch.rand(300, 400, generator=generator) + 0.1
    whole[:, :50] = 0
    places = sample(whole)
    assert len(places) == 65536
    assert len(set(places.tolist())) > 0.9 * 65536
    assert bool((whole.flatten()[places] > 0).all())
    assert torch.equal(places, places.sort().values)
    assert float(whole.flatten()[places].mean()) == pytest.approx(float(whole[:, 50:].mean()), abs=2e-3)
    assert torch.equal(sample(whole[:50]), whole[:50].flatten().nonzero().squeeze(1))


def test_columns_and_parameters_are_the_change_of_a_look() -> None:
    image = CAT[0, :, 10:30, 10:30].double().flatten(1)
    layout = PartLayout(knots=17, factors=5, sliders=4)
    columns = columns_of(image, torch.zeros(3, 7 + 6 + 3 + 8 + 4, 400), layout)
    assert columns.shape == (3, layout.columns, 400)
    coefficients = torch.zeros(3, layout.columns, dtype=torch.float64)
    straight = torch.linspace(0, 1, 17, dtype=torch.float64)
    matrix = torch.tensor(SEPIA, dtype=torch.float64).view(3, 3)
    coefficients[:, layout.place("curves")] = torch.tensor(BENT, dtype=torch.float64) - straight
    coefficients[:, layout.place("matrix")] = matrix - torch.eye(3, dtype=torch.float64)
    coefficients[:, layout.place("saturation")] = torch.tensor(VIVID, dtype=torch.float64) - 1
    curves = torch.tensor(BENT, dtype=torch.float64).expand(3, -1)
    wanted = pointwise(image[None, :, None], curves, matrix, torch.tensor(VIVID, dtype=torch.float64))[0, :, 0]
    change = (coefficients.unsqueeze(2) * columns).sum(1)
    torch.testing.assert_close(change, wanted - image)
    sums = sums_of(columns, change, torch.ones(3, 400))
    assert sums.explained(coefficients) == pytest.approx(1.0)
    assert sums.left(torch.zeros_like(coefficients)) == pytest.approx(float(change.square().sum()))


def test_sums_of_two_sets_of_pixels_add_up() -> None:
    generator = torch.Generator().manual_seed(0)
    columns, change, weights = (torch.rand(3, *shape, 30, generator=generator) for shape in ((5,), (), ()))
    parts = [sums_of(columns[..., k], change[..., k], weights[..., k]) for k in (slice(12), slice(12, 30))]
    total, whole = parts[0] + parts[1], sums_of(columns, change, weights)
    for name in LookSums.__dataclass_fields__:
        torch.testing.assert_close(getattr(total, name), getattr(whole, name))


def test_parameters_of_a_part_act_on_its_columns_alone() -> None:
    layout = PartLayout(knots=17, factors=5, sliders=4)
    spread = layout.spread(("tone", "matrix"))
    assert spread.shape == (3, layout.columns, 17 + 9)
    assert torch.equal(spread[0, layout.place("curves"), :17], torch.eye(17, dtype=torch.float64))
    assert torch.equal(spread[:, :, :17][0], spread[:, :, :17][2])  # one curve for all channels
    for channel in range(3):
        block = spread[channel, layout.place("matrix"), 17:]
        assert torch.equal(block[:, 3 * channel : 3 * channel + 3], torch.eye(3, dtype=torch.float64))
        assert float(block.sum()) == 3
