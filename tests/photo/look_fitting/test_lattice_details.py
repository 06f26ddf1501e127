"""Finer lattices where pixels are dense."""

from dataclasses import replace

import torch

from nlfilter_torch.photo.look_fitting.lattice_details import Ridged, refined
from nlfilter_torch.photo.look_fitting.lattice_fit import ColourChange, Problem, conjugate_gradients, fit_lattice
from nlfilter_torch.photo.looks.lattice import lattice_change


def pixels(count: int, ripple: float, noise: float = 0.0) -> ColourChange:
    """Colours near greys under an edit with fine ripples of colour, in three folds."""
    generator = torch.Generator().manual_seed(0)
    grey = torch.rand(count, generator=generator, dtype=torch.float64)
    before = (grey + 0.05 * torch.randn(3, count, generator=generator, dtype=torch.float64)).clamp(0, 1)
    after = before**0.8 + ripple * torch.sin(40 * before[:1])
    after = after + noise * torch.randn(3, count, generator=generator, dtype=torch.float64)
    folds = torch.arange(count) % 3
    return ColourChange(before, after, [before] * 4, torch.full((count,), 1 / count, dtype=torch.float64), folds)


def test_what_only_a_fine_lattice_can_say_is_explained_where_there_are_pixels() -> None:
    sample = pixels(20_000, 0.02)
    smooth = fit_lattice(sample)
    fine = refined(sample, smooth)
    assert fine.changes.shape == fine.first.shape == (3, 33, 33, 33)
    assert 1 - fine.left_out < 0.5 * (1 - smooth.left_out)
    assert 1 - fine.fitted < 0.5 * (1 - smooth.fitted)
    assert fine.without == smooth.without
    unseen = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).mT.reshape(1, 3, 1, 2).double()
    torch.testing.assert_close(lattice_change(unseen, fine.changes), lattice_change(unseen, smooth.changes))


def test_noise_has_no_details() -> None:
    sample = pixels(3000, 0.0, 0.05)
    smooth = fit_lattice(sample)
    fine = refined(sample, smooth)
    assert fine.changes.shape == smooth.changes.shape
    assert fine.left_out == smooth.left_out


def test_nothing_is_added_where_nothing_is_left() -> None:
    sample = pixels(500, 0.0)
    perfect = replace(sample, predicted=[sample.after] * 4)
    fine = refined(perfect, fit_lattice(perfect))
    assert fine.fitted == 1
    assert float(fine.changes.abs().max()) == 0


def test_conjugate_gradients_solve_the_problem_with_a_ridge() -> None:
    problem = Problem.of(pixels(3000, 0.02), 5)
    cross = problem.cross(0)
    ridged = Ridged(problem.sums.without(0), 1e-3)
    changes = conjugate_gradients(ridged, cross, torch.zeros_like(cross))
    matrix = torch.stack([ridged(unit.expand(1, 1, -1))[0, 0] for unit in torch.eye(125, dtype=torch.float64)])
    exact = torch.linalg.solve(matrix, cross[0].mT).mT
    assert float((changes[0] - exact).norm()) < 0.01 * float(exact.norm())
