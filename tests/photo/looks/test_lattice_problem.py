"""Least-squares problems of lattices."""

import pytest
import torch

from nlfilter_torch.photo.looks.lattice_fit import Problem
from nlfilter_torch.photo.looks.lattice_problem import CellSums, Penalised, Ridged, solve_lattices
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes
from tests.photo.looks.test_lattice_fit import pixels, rippled


def test_the_matrix_is_that_of_the_sums_and_penalties() -> None:
    sample = pixels(500, 0.7)
    problem = Problem.of(sample, 4)
    hats = torch.from_numpy(problem.shares.toarray())
    whole = Penalised(problem.sums.without(len(problem.pixels.predicted) - 1), 0.02)
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
    cross = problem.cross([0, 1, 2])
    changes = problem.solve([0, 1, 2], smooth, cross, torch.zeros_like(cross))
    for fold in range(3):
        alone = Penalised(CellSums(5, [others.grams[fold]]), smooth)
        matrix = torch.stack([alone(unit.expand(1, 1, -1))[0, 0] for unit in torch.eye(125, dtype=torch.float64)])
        exact = torch.linalg.solve(matrix, cross[fold].mT).mT
        error = changes[fold] - exact
        assert float((error @ matrix * error).sum()) < 1e-3 * float((exact @ matrix * exact).sum())


def test_conjugate_gradients_solve_the_problem_with_a_ridge() -> None:
    problem = Problem.of(rippled(3000, 0.02), 5)
    cross = problem.cross([0])
    ridged = Ridged(problem.sums.without(0), 1e-3)
    changes = solve_lattices(ridged, cross, torch.zeros_like(cross))
    matrix = torch.stack([ridged(unit.expand(1, 1, -1))[0, 0] for unit in torch.eye(125, dtype=torch.float64)])
    exact = torch.linalg.solve(matrix, cross[0].mT).mT
    assert float((changes[0] - exact).norm()) < 0.01 * float(exact.norm())
