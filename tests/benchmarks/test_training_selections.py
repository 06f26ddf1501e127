"""The training of the network of selections: cases, composites, and that it learns."""

import numpy as np
import pytest
import torch

from benchmarks.training import selections
from benchmarks.training.selections import BLOB_STROKES, EVIDENCE, SAMPLED, blobs, cases, judge, over, sampled, train
from nlfilter_torch.photo.selections.object_network import EVIDENCE_PLANES, FEATURES
from tests.problems import noise, seeded


def scene() -> tuple[torch.Tensor, np.ndarray]:
    """A picture of a red rectangle, and where it is."""
    image = 0.2 * noise(1, 3, 40, 60, dtype=torch.float32)
    image[:, 0, 10:30, 15:45] += 0.6
    wanted = np.zeros((40, 60), bool)
    wanted[10:30, 15:45] = True
    return image, wanted


def test_cases_hold_what_the_model_knows_and_the_truth() -> None:
    image, wanted = scene()
    either = np.zeros_like(wanted)
    either[:, :5] = True
    (case,) = cases(image, wanted, either, 1, np.random.default_rng(3))
    assert case.shape == (EVIDENCE + 2, 40, 60)
    assert sum(EVIDENCE_PLANES) == EVIDENCE
    assert np.array_equal(case[-2] > 0.5, wanted)
    assert np.array_equal(case[-1] < 0.5, either)
    mask = case[EVIDENCE - 1] > 0.5
    assert (mask.numpy() & wanted).sum() > 0.8 * (mask.numpy() | wanted).sum()
    points = sampled(case.float(), seeded(0))
    assert points.shape == (SAMPLED, FEATURES + 3)
    assert points.isfinite().all()


def test_objects_lie_over_another_photograph() -> None:
    image, wanted = scene()
    back = torch.zeros(1, 3, 50, 50)
    made, where = over(image, wanted, back, np.random.default_rng(0))
    assert made.shape == (1, 3, 50, 50)
    assert 0.02 < where.mean() < 0.6
    assert made[0, 0][torch.from_numpy(where)].mean() > 0.5
    assert made[0, 0].max() > 0.5


def test_blobs_have_soft_borders_and_cases_with_and_without_strokes_outside() -> None:
    images = {"a": noise(1, 3, 130, 180, dtype=torch.float32), "b": torch.zeros(1, 3, 130, 180)}
    made = list(blobs(images, 4))
    assert len(made) == 2 * len(BLOB_STROKES)
    soft = made[0][-2]
    assert bool(((soft > 0.2) & (soft < 0.8)).any())
    assert [bool((case[15] > 0).any()) for case in made] == [False, True] * len(BLOB_STROKES)


def test_the_network_learns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selections, "STEPS", 20)
    monkeypatch.setattr(selections, "RATE", 0.02)
    image, wanted = scene()
    made = torch.stack(list(cases(image, wanted, np.zeros_like(wanted), 2, np.random.default_rng(1)))).float()
    made[:, EVIDENCE - 1, :, 30:] = 0.1  # a model that misses half of the object
    data = torch.stack([sampled(case, seeded(0)) for case in made])
    weights = train(data, torch.ones(len(data)), 0)
    model, network = judge(list(made), weights)
    assert model < 0.6
    assert network > model + 0.2
    again = train(data, torch.ones(len(data)), 0)
    assert all(torch.equal(weights[name], again[name]) for name in weights)
