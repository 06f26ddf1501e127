"""Lattices by penalised least squares."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nlfilter_torch.photo.looks.lattice_fit import (
    RIDGE,
    SCARCE,
    ColourChange,
    Problem,
    Quadratic,
    fit_hues,
    fit_lattice,
    hue_columns,
    with_details,
)
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes, lattice_change


def pixels(count: int, exponent: float, noise: float = 0.0) -> ColourChange:
    """Colours near greys, whose edit depends on hue, in three folds."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.rand(count, generator=generator, dtype=torch.float64)
    before = (grey + 0.1 * torch.randn(3, count, generator=generator, dtype=torch.float64)).clamp(0, 1)
    after = before**exponent + 0.3 * (before[:1] - before[1:2]) * (1 - before)
    after = after + noise * torch.randn(3, count, generator=generator, dtype=torch.float64)
    folds = torch.arange(count) % 3
    return ColourChange(before, after, [before] * 4, torch.full((count,), 1 / count, dtype=torch.float64), folds)


def test_what_depends_on_colour_is_explained_and_colours_without_pixels_are_left_alone() -> None:
    sample = pixels(20_000, 0.7)
    lattice = fit_lattice(sample)
    assert lattice.left_out > 0.998
    assert lattice.fitted > 0.999
    assert lattice.without == pytest.approx(0)
    unseen = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).mT.reshape(1, 3, 1, 2).double()
    assert float(lattice_change(unseen, lattice.changes[1]).abs().max()) < 0.15


def test_noise_is_left_alone() -> None:
    clean = pixels(3000, 1.0)
    generator = torch.Generator().manual_seed(1)
    after = clean.before + 0.05 * torch.randn(3, 3000, generator=generator, dtype=torch.float64)
    lattice = fit_lattice(ColourChange(clean.before, after, clean.predicted, clean.weights, clean.folds))
    assert abs(lattice.left_out) < 0.02
    assert float(lattice.changes.abs().max()) < 0.05


def test_nothing_is_left_of_clipped_values_beyond_the_end() -> None:
    before = torch.tensor([[0.5, 0.5, 0.5, 0.5]], dtype=torch.float64).expand(3, -1)
    after = torch.tensor([[1.0, 1.0, 0.0, 0.9]], dtype=torch.float64).expand(3, -1)
    predicted = torch.tensor([[1.2, 0.9, -0.1, 1.2]], dtype=torch.float64).expand(3, -1)
    change = ColourChange(before, after, [predicted], torch.ones(4, dtype=torch.float64), torch.zeros(4).long())
    torch.testing.assert_close(change.left(0.0, 0)[0], torch.tensor([0.0, 0.1, 0.0, -0.3], dtype=torch.float64))


def test_another_lattice_is_added_on_the_finer_grid() -> None:
    sample = pixels(3000, 0.7)
    lattice = fit_lattice(sample)
    hue, colours = (colours_of_nodes(n).expand(2, -1, -1, -1, -1) for n in (5, 33))
    assert lattice.with_more(hue).nodes == lattice.nodes
    finer = lattice.with_more(colours)
    assert finer.nodes == 33
    places = sample.before[None, :, None]
    torch.testing.assert_close(
        lattice_change(places, finer.changes[1]),
        lattice_change(places, lattice.changes[1]) + sample.before[None, :, None],
    )


def test_the_share_that_looks_explain_of_folds_that_they_were_fitted_without() -> None:
    sample = pixels(900, 0.7)
    assert sample.explained() == pytest.approx(0)
    perfect = ColourChange(sample.before, sample.after, [sample.after] * 4, sample.weights, sample.folds)
    assert perfect.explained() == 1


def rippled(count: int, ripple: float, noise: float = 0.0) -> ColourChange:
    """Colours near greys under an edit with fine ripples of colour, in three folds."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.rand(count, generator=generator, dtype=torch.float64)
    before = (grey + 0.05 * torch.randn(3, count, generator=generator, dtype=torch.float64)).clamp(0, 1)
    after = before**0.8 + ripple * torch.sin(40 * before[:1])
    after = after + noise * torch.randn(3, count, generator=generator, dtype=torch.float64)
    folds = torch.arange(count) % 3
    return ColourChange(before, after, [before] * 4, torch.full((count,), 1 / count, dtype=torch.float64), folds)


def test_what_only_a_fine_lattice_can_say_is_explained_where_there_are_pixels() -> None:
    sample = rippled(20_000, 0.02)
    smooth = fit_lattice(sample)
    fine = with_details(sample, smooth)
    assert fine.changes.shape == (2, 3, 33, 33, 33)
    assert 1 - fine.left_out < 0.5 * (1 - smooth.left_out)
    assert 1 - fine.fitted < 0.5 * (1 - smooth.fitted)
    assert fine.without == smooth.without
    unseen = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).mT.reshape(1, 3, 1, 2).double()
    torch.testing.assert_close(lattice_change(unseen, fine.changes[1]), lattice_change(unseen, smooth.changes[1]))


def test_noise_has_no_details() -> None:
    sample = rippled(3000, 0.0, 0.05)
    smooth = fit_lattice(sample)
    fine = with_details(sample, smooth)
    assert fine.changes.shape == smooth.changes.shape
    assert fine.left_out == smooth.left_out


def test_nothing_is_added_where_nothing_is_left() -> None:
    sample = rippled(500, 0.0)
    perfect = replace(sample, predicted=[sample.after] * 4)
    fine = with_details(perfect, fit_lattice(perfect))
    assert fine.fitted == 1
    assert float(fine.changes.abs().max()) == 0


def colours(count: int, least: float, most: float, seed: int = 0) -> Tensor:
    """Colours (3, P) with all channels in a range."""
    generator = torch.Generator().manual_seed(seed)
    return least + (most - least) * torch.rand(3, count, generator=generator, dtype=torch.float64)


def greener(rgb: Tensor) -> Tensor:
    """An edit (3, P) that darkens and saturates greens."""
    red, green, blue = rgb
    amount = (green - torch.maximum(red, blue)).clamp(min=0)
    return rgb - 0.5 * amount + 0.3 * amount * (rgb - rgb.mean(0))


def in_folds(before: Tensor, after: Tensor) -> ColourChange:
    """In three folds."""
    count = before.shape[1]
    weights = torch.full((count,), 1 / count, dtype=torch.float64)
    return ColourChange(before, after, [before] * 4, weights, torch.arange(count) % 3)


def test_edits_by_hue_carry_over_to_colours_that_no_pixel_has() -> None:
    before = colours(3000, 0.2, 0.6)
    sample = in_folds(before, greener(before))
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
    assert not any(bool(lattice.any()) for lattice in fit_hues(in_folds(before, before + noise)))
    assert not any(bool(lattice.any()) for lattice in fit_hues(in_folds(before[:, :30], before[:, :30])))


def test_the_matrix_is_that_of_the_sums_and_penalties() -> None:
    sample = pixels(500, 0.7)
    problem = Problem.of(sample, 4)
    hats = torch.from_numpy(problem.shares.toarray())
    whole = Quadratic.smooth(problem.without([len(problem.pixels.predicted) - 1]), 4, 0.02)
    columns = torch.from_numpy(whole.matrices[0].toarray())
    data = hats.mT @ hats / 500
    even = float(data.sum() / 64)
    ridge = RIDGE * even * SCARCE * even / (SCARCE * even + data.sum(1))
    colours = colours_of_nodes(4).flatten(1)
    rest = columns - data - torch.diag(ridge)
    # Linear functions do not bend, others do, and equally in all directions.
    assert float((rest @ torch.cat([torch.ones(1, 64, dtype=torch.float64), colours]).mT).abs().max()) < 1e-12
    red, green = colours[0].square(), colours[1].square()
    assert float(red @ rest @ red) == pytest.approx(float(green @ rest @ green))
    torch.testing.assert_close(rest, rest.mT)
    assert float(torch.linalg.eigvalsh(rest).min()) > -1e-12


@pytest.mark.parametrize("smooth", [1.0, 1e-2, 1e-4])
def test_conjugate_gradients_solve_all_folds(smooth: float) -> None:
    problem = Problem.of(pixels(3000, 0.7), 5)
    others = problem.without([0, 1, 2])
    cross = problem.cross([0, 1, 2])
    changes = problem.solve([0, 1, 2], smooth, cross, torch.zeros_like(cross))
    for fold in range(3):
        matrix = torch.from_numpy(Quadratic.smooth([others[fold]], 5, smooth).matrices[0].toarray())
        exact = torch.linalg.solve(matrix, cross[fold].mT).mT
        error = changes[fold] - exact
        assert float((error @ matrix * error).sum()) < 1e-3 * float((exact @ matrix * exact).sum())


def test_conjugate_gradients_solve_the_problem_with_a_ridge() -> None:
    problem = Problem.of(rippled(3000, 0.02), 5)
    cross = problem.cross([0])
    ridged = Quadratic.ridged(problem.without([0]), 1e-3)
    changes = ridged.solve(cross, torch.zeros_like(cross))
    matrix = torch.from_numpy(ridged.matrices[0].toarray())
    exact = torch.linalg.solve(matrix, cross[0].mT).mT
    assert float((changes[0] - exact).norm()) < 0.01 * float(exact.norm())
