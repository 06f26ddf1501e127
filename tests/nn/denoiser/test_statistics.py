"""Windows of a photograph, and quantiles of the contrast in them."""

import torch

from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile
from nlfilter_torch.nn.denoiser.statistics import (
    KINDS,
    MOST,
    QUANTILES,
    SIDE,
    has_few_colours,
    statistics_of,
    window_pixels,
)

MEDIAN = QUANTILES.index(0.5)


def windows_of(image: torch.Tensor) -> torch.Tensor:
    places = window_pixels((image.shape[-2], image.shape[-1]))
    return image[0].flatten(1)[:, places].transpose(0, 1)


def noisy(*size: int, level: float = 0.05, light: float = 0.5) -> torch.Tensor:
    return light + level * torch.randn(*size, generator=torch.Generator().manual_seed(0))


WINDOWS = [(1, 1), (5, 40), (128, 128), (129, 300), (700, 431), (3000, 4001), (20, 100_000)]


def test_windows_lie_in_the_picture_and_are_the_same_seen_from_either_side() -> None:
    for size in WINDOWS:
        places = window_pixels(size)
        assert len(places) <= MOST
        assert places.shape[1:] == (SIDE, SIDE)
        assert int(places.min()) >= 0
        assert int(places.max()) < size[0] * size[1]
        rows, columns = places // size[1], places % size[1]
        for flipped in ((size[0] - 1 - rows) * size[1] + columns, rows * size[1] + size[1] - 1 - columns):
            if min(size) >= SIDE:
                assert torch.equal(flipped.unique(), places.unique())
        if size[0] * size[1] <= MOST * SIDE**2 / 4:
            assert len(places.unique()) == size[0] * size[1]


def test_white_noise_has_its_level_everywhere() -> None:
    statistics, shares = statistics_of(windows_of(noisy(1, 3, 400, 400)))
    assert statistics.shape == (KNOTS, len(NoiseProfile.SCALES), KINDS, 2, len(QUANTILES))
    levels = statistics.exp()[2, ..., MEDIAN]
    wanted = torch.tensor([3**-0.5, 3**-0.5, 1, 1])[:, None] * 0.05
    torch.testing.assert_close(levels[:3], wanted.expand(3, -1, 2), rtol=0.05, atol=0)
    torch.testing.assert_close(levels[3:], wanted.expand(2, -1, 2), rtol=0.2, atol=0)
    torch.testing.assert_close(shares.sum(0), torch.ones(5), rtol=1e-3, atol=0)
    assert float(shares[2:4].sum(0).min()) > 0.95


def test_statistics_do_not_depend_on_flips_and_rotations() -> None:
    image = noisy(1, 3, 260, 330).clamp(0, 1)
    statistics, shares = statistics_of(windows_of(image))
    for turned in (image.flip(2), image.flip(3), image.rot90(1, (2, 3))):
        other, others = statistics_of(windows_of(turned))
        torch.testing.assert_close(other, statistics, rtol=0, atol=0.02)
        torch.testing.assert_close(others, shares, rtol=0, atol=1e-3)


def test_clipped_cells_do_not_count() -> None:
    image = noisy(1, 3, 256, 256)
    image[..., :128] = 0
    statistics, shares = statistics_of(windows_of(image))
    assert float(shares[0].max()) < 1e-3
    torch.testing.assert_close(statistics[2, 0, 2, 1, MEDIAN].exp(), torch.tensor(0.05), rtol=0.05, atol=0)
    _, none = statistics_of(windows_of(torch.zeros(1, 1, 64, 64)))
    assert float(none.abs().max()) == 0


def test_pictures_of_few_colours() -> None:
    image = noisy(1, 3, 200, 200)
    assert not bool(has_few_colours(windows_of(image)))
    assert not bool(has_few_colours(windows_of((255 * image).round() / 255)))
    assert not bool(has_few_colours(windows_of(noisy(1, 1, 200, 200, level=1e-4))))
    palette = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    indices = torch.randint(64, (200, 200), generator=torch.Generator().manual_seed(0))
    assert bool(has_few_colours(windows_of(palette[indices].permute(2, 0, 1)[None])))
    assert bool(has_few_colours(windows_of((noisy(1, 1, 200, 200) > 0.5).float())))
    for channels in (2, 4):  # pictures may have any number
        windows = noisy(9, channels, 48, 48)
        assert not bool(has_few_colours(windows))
        assert bool(has_few_colours(windows.round()))
