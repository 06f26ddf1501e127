"""Random walker: the solution of a dense linear system."""

import numpy as np
import pytest

from nlfilter_torch.photo.selections import random_walker
from tests.problems import noise


@pytest.mark.parametrize("channels", [1, 3])
def test_the_local_solve_is_that_of_the_linear_system(monkeypatch: pytest.MonkeyPatch, channels: int) -> None:
    monkeypatch.setattr(random_walker, "STEPS", (3000,))
    height, width = 7, 9
    image, rough = noise(1, channels, height, width), noise(1, 2, height, width, seed=1)
    trust = 0.05 + noise(1, 2, height, width, seed=2)
    solved = random_walker.solve_mask(image, rough, trust)
    pixels = image[0].flatten(1).T.numpy()
    rows, columns = np.divmod(np.arange(height * width), width)
    near = np.maximum(abs(rows[:, None] - rows), abs(columns[:, None] - columns)) == 1
    squares = np.square(pixels[:, None] - pixels).mean(2)
    weights = near * (np.exp(-random_walker.STEEPNESS * squares) + random_walker.MIN_WEIGHT)
    laplacian = np.diag(weights.sum(1)) - weights
    for k in range(2):
        c = trust[0, k].flatten().numpy()
        expected = np.linalg.solve(laplacian + np.diag(c), c * rough[0, k].flatten().numpy())
        np.testing.assert_allclose(solved[0, k].flatten(), expected, atol=1e-6)
