"""What the parts of a look do to pixels."""

import numpy as np
import pytest
import skimage.color
import skimage.data
import skimage.exposure
import torch

from nlfilter_torch.photo import apply_look, enhance
from nlfilter_torch.photo.looks.look_filter import bands_of, tone_curve
from tests.looks import ALPHA, BENT, CAT, SEPIA, VIVID


def test_bands_add_up_to_the_image() -> None:
    bands = list(bands_of(CAT.double()))
    assert len(bands) == 7
    assert torch.allclose(sum(bands[1:], bands[0]), CAT.double(), atol=1e-12)
    assert all(bands[i].square().mean() > 0 for i in range(7))


def test_the_parts_are_what_they_say() -> None:
    points = torch.tensor(BENT)
    by_hand = torch.from_numpy(np.interp(CAT.numpy(), [i / 16 for i in range(17)], BENT)).float()
    assert torch.allclose(tone_curve(CAT, points.expand(3, -1)), by_hand, atol=1e-6)
    sepia = torch.tensor(SEPIA).view(3, 3)
    assert torch.allclose(apply_look(CAT, matrix=SEPIA), torch.einsum("cd,bdhw->bchw", sepia, CAT), atol=1e-6)
    contrast = apply_look(CAT, bands=(1.4,) * 7)
    mean = (CAT * torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)).sum(1).mean()
    assert torch.allclose(contrast, mean + 1.4 * (CAT - mean), atol=1e-5)
    sliders = apply_look(CAT, alpha=ALPHA, num_landmarks=40)
    detail = enhance(CAT, torch.tensor(ALPHA), limits="none", threshold=0.0, num_landmarks=40)
    assert torch.allclose(sliders, detail, atol=1e-5)
    hsv = skimage.color.rgb2hsv(CAT[0].permute(1, 2, 0).double().numpy())
    hsv[..., 1] *= np.interp(hsv[..., 1], [0, 0.25, 0.5, 0.75, 1], VIVID)
    by_hand = torch.from_numpy(skimage.color.hsv2rgb(hsv)).permute(2, 0, 1)[None].float()
    assert torch.allclose(apply_look(CAT, saturation=VIVID), by_hand, atol=1e-5)
    assert torch.allclose(
        apply_look(CAT, matrix=SEPIA, amount=0.5), (CAT + apply_look(CAT, matrix=SEPIA)) / 2, atol=1e-6
    )


def test_texture_is_the_fine_band_where_luminance_varies_little() -> None:
    image = CAT.double()
    light = (image * torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(3, 1, 1)).sum(1)[0].numpy()
    weights = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256

    def blurred(row: int, column: int, values: np.ndarray) -> float:
        return float((values[row - 2 : row + 3, column - 2 : column + 3] * weights).sum())

    added = apply_look(image, texture=(2.0, 1.0, 1.0, 1.0, 1.0, 1.0)) - image
    for row, column in ((2, 2), (30, 41), (60, 80)):
        mean = blurred(row, column, light)
        variance = blurred(row, column, light**2) - mean**2
        change = (light[row, column] - mean) * 0.15**2 / (0.15**2 + variance)
        assert added[0, :, row, column].tolist() == pytest.approx([change] * 3, abs=1e-9)
