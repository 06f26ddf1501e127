"""The edits of some pixels are those of the whole picture."""

import pytest
import torch

from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.look_fitting.own_edits import OwnDetail, OwnEdit, OwnSharpen, OwnTone
from nlfilter_torch.photo.picture.in_memory import InMemory
from tests.looks import CAT

FEW = (("landmarks", 40),)
CASES: list[tuple[OwnEdit, tuple[float, ...]]] = [
    (OwnDetail(filter=FEW), (2.2, 0.6, 1.4, 1.05, 8.0)),
    (OwnDetail(filter=FEW, limits="none", order=2), (0.5, 2.0, 1.0, 0.0)),
    (OwnTone(filter=FEW), (1.3, 0.5)),
    (OwnTone(filter=FEW, limits="none"), (0.8, 1.5)),
    (OwnSharpen(), (4.0,)),
]


@pytest.mark.parametrize(("edit", "values"), CASES)
def test_edits_of_samples_are_those_of_the_picture(edit: OwnEdit, values: tuple[float, ...]) -> None:
    wanted = apply_step(edit.step(values), CAT)
    seen = edit.ingredients(CAT, edit.operator(InMemory(CAT)))
    assert torch.allclose(edit.edited(seen, torch.tensor(values)), wanted, atol=1e-6)
    places = torch.arange(0, 8000, 2)
    sampled = edit.edited(seen.at(places), torch.tensor(values, dtype=torch.float64))
    assert sampled.shape == (1, 3, 1, 4000)
    assert float((sampled[..., 0, :] - wanted.flatten(2)[..., places]).abs().max()) < 0.004  # its means differ
    assert torch.equal(seen.at(places).every(4).image, seen.at(places[::4]).image)


def test_rough_layers_are_nearly_those_of_the_picture() -> None:
    edit, places = OwnDetail(filter=FEW), torch.arange(0, 8000, 4)
    exact = edit.ingredients(CAT, edit.operator(InMemory(CAT))).at(places).layers
    rough = edit.roughly(CAT, places).layers
    assert float((rough - exact).square().sum() / exact[:, :-1].square().sum()) < 0.04
    assert (2.2, 2.2, 2.2, 1.0, 5.0) in edit.known


@pytest.mark.parametrize("edit", [OwnDetail(filter=FEW), OwnTone(filter=FEW), OwnSharpen()])
def test_idle_values_change_nothing(edit: OwnEdit) -> None:
    seen = edit.ingredients(CAT, edit.operator(InMemory(CAT)))
    assert torch.equal(edit.edited(seen, torch.tensor(edit.idle)), CAT)
    assert not edit.step(edit.idle).changes()
    assert len(edit.start) == len(edit.ends) == len(edit.idle)
