"""Drawings of the editor: pictures, masks, strokes, histograms and responses."""

import io

import numpy as np
import torch
from PIL import Image

from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.declared.strokes import Stroke
from tests.problems import cat


def decoded(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


def test_pictures() -> None:
    image = cat()
    decoded_picture = torch.from_numpy(decoded(drawing.picture(image)).copy()).permute(2, 0, 1)[None] / 255
    assert (decoded_picture - image).square().mean().sqrt() * 255 < 3
    assert decoded(drawing.picture(image[:, :1])).shape == (100, 150)
    mask = torch.linspace(0, 1, 15000).view(1, 1, 100, 150)
    layer = decoded(drawing.mask_picture(mask, drawing.TINTS[0]))
    assert layer.shape == (100, 150, 4)
    assert (layer[0, 0, 3], layer[-1, -1, 3]) == (0, drawing.OPACITY)
    assert decoded(drawing.picture(torch.rand(1, 3, 1, 40))).shape == (1, 40, 3)


def test_the_mask_contrasts_with_the_picture() -> None:
    everywhere = torch.ones(1, 1, 20, 20)
    for colour in drawing.TINTS:
        image = torch.tensor(colour).view(1, 3, 1, 1).expand(-1, -1, 20, 20) / 255
        assert drawing.contrasting_tint(image, everywhere) != colour
    lines = decoded(drawing.hatching(everywhere))
    assert {tuple(pixel) for pixel in lines.reshape(-1, 4)} == {(0, 0, 0, 0), (0, 0, 0, 255), (255, 255, 255, 255)}
    assert not decoded(drawing.hatching(torch.zeros(1, 1, 20, 20))).any()


def test_strokes_are_drawn_as_painted() -> None:
    svg = drawing.strokes_svg(
        [Stroke(((0.5, 0.25),), 0.1, "in"), Stroke(((0.0, 0.0), (1.0, 1.0)), 0.1, "#aabbcc")], (100, 200)
    )
    assert 'd="M100.0 25.0L100.0 25.0" stroke="#22c55e" stroke-width="20.0"' in svg
    assert 'd="M0.0 0.0L200.0 100.0" stroke="#aabbcc"' in svg


def test_response_has_a_line_for_each_region_and_a_dot_for_each_eigenvalue() -> None:
    eigenvalues = torch.tensor([1.0, 0.5, 0.0])
    svg = drawing.response_svg(eigenvalues, [("red", (3.0, 1.0)), ("blue", (0.0, 0.0, 1.0))])
    assert svg.count("<polyline") == 2
    assert svg.count("<circle") == 6
    assert svg.count('class="mark"') == 3
    # Gains from 0 to 3 lie between y = 112 and y = 10; sliders (3, 1) give 3, 2, 1.
    assert [f'cy="{y:.1f}" r="1.6" fill="red"' in svg for y in (10.0, 44.0, 78.0)] == [True] * 3
