"""Lattices by penalised least squares."""

import pytest
import torch

from nlfilter_torch.photo.look_fitting.lattice_fit import CellSums, ColourChange, Penalised, Problem, fit_lattice
from nlfilter_torch.photo.looks.lattice import colours_of_nodes, lattice_change


def pixels(count: int, exponent: float, noise: float = 0.0) -> ColourChange:
    """Colours near greys, whose edit depends on hue, in three folds."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.rand(count, generator=generator, dtype=torch.float64)
    before = (grey + 0.1 * torch.randn(3, count, generator=generator, dtype=torch.float64)).clamp(0, 1)
    after = before**exponent + 0.3 * (before[:1] - before[1:2]) * (1 - before)
    after = after + noise * torch.randn(3, count, generator=generator, dtype=torch.float64)
    folds = torch.arange(count) % 3
    return ColourChange(before, after, [before] * 4, torch.full((count,), 1 / count, dtype=torch.float64), folds)


def test_the_matrix_is_that_of_the_sums_and_penalties() -> None:
    sample = pixels(500, 0.7)
    problem = Problem.of(sample, 4)
    hats = torch.zeros(500, 64, dtype=torch.float64).scatter_add_(1, problem.places.mT, problem.shares.mT)
    whole = Penalised(problem.sums.all(), 0.02)
    columns = torch.cat([whole(unit.expand(1, 3, -1))[:, :1] for unit in torch.eye(64, dtype=torch.float64)], dim=1)[0]
    data = hats.mT @ hats / 500
    colours = colours_of_nodes(4).flatten(1)
    rest = columns - data - torch.diag(whole.ridge[0])
    # Linear functions do not bend, others do, and equally in all directions.
    assert float((rest @ torch.cat([torch.ones(1, 64, dtype=torch.float64), colours]).mT).abs().max()) < 1e-12
    red, green = colours[0].square(), colours[1].square()
    assert float(red @ rest @ red) == pytest.approx(float(green @ rest @ green))
    torch.testing.assert_close(rest, rest.mT)
    assert float(torch.linalg.eigvalsh(rest).min()) > -1e-12


@pytest.mark.parametrize("smooth", [1.0, 1e-2, 1e-4])
def test_conjugate_gradients_solve_all_folds(smooth: float) -> None:
    problem = Problem.of(pixels(3000, 0.7), 5)
    others = problem.sums.without(0, 1, 2)
    cross = problem.cross(0, 1, 2)
    changes = problem.solve([0, 1, 2], smooth, cross, torch.zeros_like(cross))
    for fold in range(3):
        alone = Penalised(CellSums(5, others.bands[:, [fold]]), smooth)
        matrix = torch.stack([alone(unit.expand(1, 1, -1))[0, 0] for unit in torch.eye(125, dtype=torch.float64)])
        exact = torch.linalg.solve(matrix, cross[fold].mT).mT
        error = changes[fold] - exact
        assert float((error @ matrix * error).sum()) < 1e-3 * float((exact @ matrix * exact).sum())


def test_what_depends_on_colour_is_explained_and_colours_without_pixels_are_left_alone() -> None:
    sample = pixels(20_000, 0.7)
    lattice = fit_lattice(sample)
    assert lattice.left_out > 0.998
    assert lattice.fitted > 0.999
    assert lattice.without == pytest.approx(0)
    unseen = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).mT.reshape(1, 3, 1, 2).double()
    assert float(lattice_change(unseen, lattice.changes).abs().max()) < 0.15


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
    nodes, (hue, colours) = lattice.changes.shape[1], (colours_of_nodes(n) for n in (5, 33))
    assert lattice.with_more(hue).changes.shape[1] == nodes
    finer = lattice.with_more(colours)
    assert finer.density.shape == (33**3,)
    places = sample.before[None, :, None]
    torch.testing.assert_close(
        lattice_change(places, finer.changes), lattice_change(places, lattice.changes) + sample.before[None, :, None]
    )


def test_the_share_that_looks_explain_of_folds_that_they_were_fitted_without() -> None:
    sample = pixels(900, 0.7)
    assert sample.explained() == pytest.approx(0)
    perfect = ColourChange(sample.before, sample.after, [sample.after] * 4, sample.weights, sample.folds)
    assert perfect.explained() == 1
