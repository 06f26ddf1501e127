"""Both solves for soft masks, against dense linear systems."""

import numpy as np
import pytest
import torch

from nlfilter_torch import region_mask
from nlfilter_torch.photo.selections import matting
from tests.problems import box, colour, noise


@pytest.mark.parametrize("channels", [1, 3])
def test_the_local_solve_is_that_of_the_linear_system(monkeypatch: pytest.MonkeyPatch, channels: int) -> None:
    monkeypatch.setattr(matting, "STEPS", (3000,))
    height, width = 7, 9
    image, rough = noise(1, channels, height, width), noise(1, 2, height, width, seed=1)
    trust = 0.05 + noise(1, 2, height, width, seed=2)
    found = matting.solve_mask(image, rough, trust)
    pixels = image[0].flatten(1).T.numpy()
    rows, columns = np.divmod(np.arange(height * width), width)
    near = np.maximum(abs(rows[:, None] - rows), abs(columns[:, None] - columns)) == 1
    squares = np.square(pixels[:, None] - pixels).mean(2)
    weights = near * (np.exp(-matting.STEEPNESS * squares) + matting.MIN_WEIGHT)
    laplacian = np.diag(weights.sum(1)) - weights
    for k in range(2):
        c = trust[0, k].flatten().numpy()
        expected = np.linalg.solve(laplacian + np.diag(c), c * rough[0, k].flatten().numpy())
        np.testing.assert_allclose(found[0, k].flatten(), expected, atol=1e-6)


def test_the_second_solve_is_closed_form_matting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matting, "LINEAR_LEVELS", 1)
    monkeypatch.setattr(matting, "LINEAR_STEPS", 3000)
    monkeypatch.setattr(matting, "SLOWEST", 1e-5)
    height, width, count = 6, 7, 42
    image, rough = noise(1, 3, height, width), noise(1, 1, height, width, seed=1)
    front, back = box(1, 1, 2, 2, size=(height, width)).double(), box(4, 4, 1, 2, size=(height, width)).double()
    functions = matting.solve_linear(matting.linear_models(image), torch.full_like(rough, 0.5), rough, front, back)
    pixels = image[0].flatten(1).T.numpy()
    rows, columns = np.divmod(np.arange(count), width)
    near = np.maximum(abs(rows[:, None] - rows), abs(columns[:, None] - columns)) <= matting.WINDOW_RADIUS
    share = near / near.sum(1, keepdims=True)  # weights of pixels in windows, and of windows around a pixel
    smooth = np.zeros((count, count))
    for middle in range(count):
        inside = near[middle].nonzero()[0]
        some = pixels[inside] - pixels[inside].mean(0)
        slopes = np.linalg.inv(some.T @ some / len(inside) + matting.NOISE * np.eye(3)) @ some.T / len(inside)
        values = (pixels - pixels[inside].mean(0)) @ slopes + 1 / len(inside)  # values of every pixel from those inside
        smooth[:, inside] += share[:, [middle]] * values
    trust = matting.LINEAR_ROUGH_CONFIDENCE * (np.square(2 * rough.numpy().ravel() - 1) + 0.01)
    certain = matting.LINEAR_SCRIBBLE_CONFIDENCE * (front + back).numpy().ravel()
    target = trust * rough.numpy().ravel() + matting.LINEAR_SCRIBBLE_CONFIDENCE * front.numpy().ravel()
    expected = np.linalg.solve(np.diag(1 + trust + certain) - smooth, target)
    found = matting.linear_mask(image - 0.5, functions[:, 0])
    stretched = (smooth @ expected.clip(0, 1) - matting.END_MARGIN) / (1 - 2 * matting.END_MARGIN)
    np.testing.assert_allclose(found.flatten(), stretched, atol=1e-5)


@pytest.mark.parametrize("name", ["coffee", "chelsea", "astronaut"])
def test_the_second_solve_is_the_same_in_float32(name: str) -> None:
    image = (255 * colour(name, 110, 130)).round() / 255
    front, back = box(50, 50, 8, 12, size=(110, 130)), box(4, 8, 8, 12, size=(110, 130))
    rough = region_mask(image, front, back, num_landmarks=40)
    found = []
    for dtype in (torch.float32, torch.float64):
        some, *masks = (planes.to(dtype) for planes in (image, rough, rough, front, back))
        functions = matting.solve_linear(matting.linear_models(some), *masks)
        assert functions.dtype == dtype
        found.append(matting.linear_mask(some - 0.5, functions[:, 0]))
    torch.testing.assert_close(found[0].double(), found[1], atol=2e-3, rtol=0)
