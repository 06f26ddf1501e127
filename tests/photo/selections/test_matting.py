"""Closed-form matting: the solution of a dense linear system, and its precision."""

import numpy as np
import pytest
import torch

from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.selections import matting
from tests.problems import box, colour, noise


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_window_sums_follow_the_radius(monkeypatch: pytest.MonkeyPatch, radius: int) -> None:
    monkeypatch.setattr(matting, "WINDOW_RADIUS", radius)
    planes, width = noise(2, 3, 5, 9), 2 * radius + 1
    wanted = torch.nn.functional.avg_pool2d(planes, width, 1, radius) * width**2
    torch.testing.assert_close(matting.window_sums(planes), wanted)


def test_masks_are_solved_by_several_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    image, rough = noise(2, 3, 12, 14), noise(2, 3, 12, 14, seed=1)
    front, back = rough > 0.9, rough < 0.1
    models, trimap = matting.linear_models(image), torch.linspace(0, 1, 6, dtype=torch.float64).view(2, 3)
    arguments = (models, rough, front.double(), back.double(), trimap)
    alone = matting.solve_linear(*arguments)
    monkeypatch.setattr(matting, "threads_for", lambda *_: 4)
    torch.testing.assert_close(matting.solve_linear(*arguments), alone, atol=1e-9, rtol=1e-9)


def test_the_solve_is_that_of_the_linear_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matting, "LINEAR_LEVELS", 1)
    monkeypatch.setattr(matting, "LINEAR_STEPS", 3000)
    monkeypatch.setattr(matting, "SLOWEST", 1e-5)
    height, width, count = 6, 7, 42
    image, rough = noise(1, 3, height, width), noise(1, 1, height, width, seed=1)
    front, back = box(1, 1, 2, 2, size=(height, width)).double(), box(4, 4, 1, 2, size=(height, width)).double()
    functions = matting.solve_linear(matting.linear_models(image), rough, front, back, rough.new_zeros(1, 1))
    pixels = image[0].flatten(1).T.numpy()
    rows, columns = np.divmod(np.arange(count), width)
    near = np.maximum(abs(rows[:, None] - rows), abs(columns[:, None] - columns)) <= matting.WINDOW_RADIUS
    share = near / near.sum(1, keepdims=True)  # weights of pixels in windows, and of windows around a pixel
    smooth = np.zeros((count, count))
    for middle in range(count):
        inside = near[middle].nonzero()[0]
        centred = pixels[inside] - pixels[inside].mean(0)
        slopes = np.linalg.inv(centred.T @ centred / len(inside) + matting.NOISE * np.eye(3)) @ centred.T / len(inside)
        values = (pixels - pixels[inside].mean(0)) @ slopes + 1 / len(inside)  # values of every pixel from those inside
        smooth[:, inside] += share[:, [middle]] * values
    trust = matting.LINEAR_ROUGH_CONFIDENCE * (np.square(2 * rough.numpy().ravel() - 1) + 0.01)
    certain = matting.LINEAR_SCRIBBLE_CONFIDENCE * (front + back).numpy().ravel()
    target = trust * rough.numpy().ravel() + matting.LINEAR_SCRIBBLE_CONFIDENCE * front.numpy().ravel()
    expected = np.linalg.solve(np.diag(1 + trust + certain) - smooth, target)
    solved = matting.linear_mask(image - 0.5, functions[:, 0])
    margin = matting.CERTAIN_MARGIN[0]
    stretched = (smooth @ expected.clip(0, 1) - margin) / (1 - 2 * margin)
    np.testing.assert_allclose(solved.flatten(), stretched, atol=1e-5)


@pytest.mark.parametrize("name", ["coffee", "chelsea", "astronaut"])
def test_the_solve_is_the_same_in_float32(name: str) -> None:
    image = (255 * colour(name, 110, 130)).round() / 255
    front, back = box(50, 50, 8, 12, size=(110, 130)), box(4, 8, 8, 12, size=(110, 130))
    rough = region_mask(image, front, back, num_landmarks=40)
    solved = []
    for dtype in (torch.float32, torch.float64):
        colours, *masks = (planes.to(dtype) for planes in (image, rough, front, back))
        functions = matting.solve_linear(matting.linear_models(colours), *masks, colours.new_zeros(1, 1))
        assert functions.dtype == dtype
        solved.append(matting.linear_mask(colours - 0.5, functions[:, 0]))
    torch.testing.assert_close(solved[0].double(), solved[1], atol=2e-3, rtol=0)
