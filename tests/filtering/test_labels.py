"""Labels are extended as by the dense matrix."""

import pytest
import torch

from nlfilter_torch import operator_from_features, propagate_labels
from tests.problems import noise


def test_scores_are_those_of_the_dense_matrix() -> None:
    operator = operator_from_features(2 * noise(2, 2, 30), size=(30,), num_landmarks=12)
    labels = torch.full((1, 30), -1)
    labels[0, [2, 9, 20]] = torch.tensor([0, 2, 0])
    known = torch.zeros(2, 3, 30, dtype=torch.float64)
    known[:, [0, 2, 0], [2, 9, 20]] = 1
    system = 6 * torch.eye(30, dtype=torch.float64) - 5 * operator.to_dense()
    scores = torch.linalg.solve(system, known.mT).mT.clamp(min=0)
    torch.testing.assert_close(propagate_labels(operator, labels, strength=5.0), scores / scores.sum(1, keepdim=True))


@pytest.mark.parametrize(
    ("labels", "error", "words"),
    [
        (torch.zeros(1, 9), TypeError, "^labels must be integers"),
        (torch.zeros(9, dtype=torch.long), ValueError, r"^labels must have shape \(1, N\)"),
        (torch.zeros(1, 8, dtype=torch.long), ValueError, "^labels must have shape"),
        (torch.full((1, 9), -1), ValueError, "and some known, got -1 to -1"),
        (torch.full((1, 9), -2), ValueError, "^labels must be -1 or classes"),
    ],
)
def test_refusals(labels: torch.Tensor, error: type[Exception], words: str) -> None:
    operator = operator_from_features(noise(1, 2, 9), size=(9,), num_landmarks=4)
    with pytest.raises(error, match=words):
        propagate_labels(operator, labels)
    with pytest.raises(ValueError, match=r"^strength"):
        propagate_labels(operator, torch.zeros(1, 9, dtype=torch.long), strength=0.0)
