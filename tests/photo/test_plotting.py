"""Figures are laid out to the pixel."""

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from nlfilter_torch import detail_layers, nonlocal_operator
from nlfilter_torch.photo.plotting import save_figure, show_eigenvectors, show_images, show_layers, show_mask


def rendered(figure: Figure, folder: Path) -> np.ndarray:
    """(H, W, 3) in 0..255."""
    save_figure(figure, folder / "figure.png")
    with Image.open(folder / "figure.png") as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def test_images_keep_their_pixels(tmp_path: Path) -> None:
    """At its own size a picture is drawn without interpolation, under a title."""
    image = torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(0))
    figure = rendered(show_images({"left": image, "right": 1 - image}, side=60), tmp_path)
    assert figure.shape == (40 + 35 + 15, 2 * 60 + 3 * 15, 3)
    wanted = (255 * image[0].permute(1, 2, 0)).round().numpy()
    assert np.abs(figure[35:75, 15:75] - wanted).max() <= 1
    assert np.abs(figure[35:75, 90:150] - (255 - wanted)).max() <= 1
    assert figure[:35].min() < 100  # the titles


def test_grey_images_and_rows(tmp_path: Path) -> None:
    image = torch.full((1, 20, 10), 0.5)
    figure = rendered(show_images({"a": image, "b": 2 * image, "c": 3 * image}, columns=2, side=20), tmp_path)
    assert figure.shape == (2 * (20 + 35) + 15, 2 * 10 + 3 * 15, 3)
    assert (figure[35:55, 15:25] == 127).all() or (figure[35:55, 15:25] == 128).all()
    assert (figure[90:110, 15:25] == 255).all()  # 1.5 is clipped


def test_large_titles_take_several_lines(tmp_path: Path) -> None:
    """Titles have the requested height, and are above the pictures and no wider than they are."""
    white = torch.ones(1, 3, 100, 200)
    for title, lines in (("one", 1), ("several words in a row, on some lines", 4)):
        figure = rendered(show_images({title: white, "b": white}, side=200, letters=27), tmp_path)
        above = figure.shape[0] - 100 - 15
        assert 27 * lines <= above <= 27 * 1.2 * (lines + 1)
        ink = np.argwhere(figure.min(-1) < 128)
        assert ink[:, 0].max() < above  # the pictures are white
        assert ink[:, 0].max() - ink[:, 0].min() >= 27 * (lines - 1) + 15
        assert ink[:, 1].min() >= 0
        assert not (figure[:, 215:230].min(-1) < 128).any()  # between the two


@pytest.mark.parametrize("constant", [False, True])
def test_figures_of_any_image(tmp_path: Path, constant: bool) -> None:
    """A constant image has empty layers and few eigenvectors; its figures can still be drawn."""
    noise = torch.rand(1, 3, 24, 30, generator=torch.Generator().manual_seed(0))
    image = torch.full_like(noise, 0.4) if constant else noise
    operator = nonlocal_operator(image, num_landmarks=12)
    spectrum = operator.spectrum()
    region = torch.zeros(1, 1, 24, 30)
    region[..., 5:9, 5:9] = 1
    for figure in (
        show_layers(detail_layers(operator, image, order=4)),
        show_eigenvectors(spectrum, numbers=(1, 2, 3, 400)),
        show_mask(image, region, region),
    ):
        assert rendered(figure, tmp_path).std() > 5


def test_mask_colours_what_it_covers(tmp_path: Path) -> None:
    red = torch.tensor([0.9, 0.1, 0.1]).view(1, 3, 1, 1).expand(1, 3, 512, 512)
    mask = torch.zeros(1, 1, 512, 512)
    mask[..., :256] = 1
    figure = rendered(show_mask(red, mask, mask), tmp_path)
    third = figure[35:547, 15 + 2 * 527 : 527 + 2 * 527]
    assert np.abs(third[:, :250] - 255 * np.array([0.9, 0.1, 0.1])).max() < 2
    assert (third[:, 270:].max(-1) - third[:, 270:].min(-1)).max() <= 1  # faded to grey
