"""Parameters of hues, sampled on a grid."""

import torch
from torch import Tensor

from nlfilter_torch.photo.look_fitting.hue_fit import fit_hues, hue_columns
from nlfilter_torch.photo.look_fitting.lattice_fit import ColourChange
from nlfilter_torch.photo.looks.lattice import lattice_change


def colours(count: int, least: float, most: float, seed: int = 0) -> Tensor:
    """Colours (3, P) with all channels in a range."""
    generator = torch.Generator().manual_seed(seed)
    return least + (most - least) * torch.rand(3, count, generator=generator, dtype=torch.float64)


def greener(rgb: Tensor) -> Tensor:
    """An edit (3, P) that darkens and saturates greens."""
    red, green, blue = rgb
    amount = (green - torch.maximum(red, blue)).clamp(min=0)
    return rgb - 0.5 * amount + 0.3 * amount * (rgb - rgb.mean(0))


def pixels(before: Tensor, after: Tensor) -> ColourChange:
    """In three folds."""
    count = before.shape[1]
    weights = torch.full((count,), 1 / count, dtype=torch.float64)
    return ColourChange(before, after, [before] * 4, weights, torch.arange(count) % 3)


def test_edits_by_hue_carry_over_to_colours_that_no_pixel_has() -> None:
    before = colours(3000, 0.2, 0.6)
    sample = pixels(before, greener(before))
    lattices = fit_hues(sample)
    assert len(lattices) == 4
    assert 1 - sample.followed_by(lattices).explained() < 0.1
    unseen = colours(500, 0.1, 0.9, seed=1)
    shown = unseen + lattice_change(unseen[None, :, None], lattices[-1])[0, :, 0]
    wanted = greener(unseen)
    assert float((shown - wanted).square().mean()) < 0.2 * float((unseen - wanted).square().mean())


def test_greys_stay_and_columns_are_of_each_hue() -> None:
    greys = torch.linspace(0, 1, 20, dtype=torch.float64).expand(3, -1)
    assert float(hue_columns(greys).abs().max()) < 1e-15
    red = hue_columns(torch.tensor([[0.8], [0.2], [0.2]], dtype=torch.float64)).view(6, 8, 3)
    assert bool((red[1:] == 0).all())
    assert bool((red[0].abs().sum(1) > 0).all())


def test_noise_has_no_hues() -> None:
    before = colours(3000, 0.0, 1.0)
    noise = 0.05 * torch.randn(3, 3000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert not any(bool(lattice.any()) for lattice in fit_hues(pixels(before, before + noise)))
    assert not any(bool(lattice.any()) for lattice in fit_hues(pixels(before[:, :30], before[:, :30])))
