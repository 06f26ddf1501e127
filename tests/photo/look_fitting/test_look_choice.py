"""Choosing the parts of a look, and least squares with bounds."""

import torch

from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.look_fitting.look_choice import CHOICES, Candidate, nonnegative, simplest
from tests.looks import CAT, FEW, in_bytes, single_look


def test_nonnegative_least_squares_meets_its_conditions() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        root = torch.rand(12, 8, generator=generator, dtype=torch.float64) - 0.3
        matrix, vector = root.mT @ root, torch.rand(8, generator=generator, dtype=torch.float64) - 0.5
        solution = nonnegative(matrix, vector)
        slope = vector - matrix @ solution
        assert float(solution.min()) >= 0
        assert float(slope.max()) < 1e-8
        assert float((slope * solution).abs().max()) < 1e-8


def test_curves_never_fall() -> None:
    after = in_bytes(0.5 + 0.4 * torch.sin(9 * CAT))  # a curve that rises and falls
    look = single_look(fit_look([(CAT, after)], parts=("curves",), step=FEW))
    curves = look.tensors["curves"]
    assert float(curves.diff(dim=1).min()) >= -1e-5
    assert float(curves.diff(dim=1).max()) > 0.01


def test_of_candidates_that_leave_as_little_the_first_is_the_simplest() -> None:
    nothing = torch.zeros(3, 1)
    risks = {("matrix",): 0.3, ("tone",): 0.105, ("curves",): 0.1}
    candidates = {parts: Candidate(parts, nothing, 0.9, 0.9, risk) for parts, risk in risks.items()}
    assert simplest(candidates).parts == ("tone",)
    assert len(set(CHOICES)) == len(CHOICES)


def test_what_parts_add_is_what_the_look_explains() -> None:
    blurred = torch.nn.functional.avg_pool2d(CAT, 3, 1, 1, count_include_pad=False)
    after = in_bytes((CAT + 0.5 * (CAT - blurred)).clamp(0, 1) ** 0.7 * torch.tensor([1.0, 0.9, 0.8]).view(1, 3, 1, 1))
    look = single_look(fit_look([(CAT, after)], step=FEW))
    assert set(look.added) == set(look.parts)
    assert len(look.added) > 1
    fitted, left_out = (sum(shares) for shares in zip(*look.added.values(), strict=True))
    assert abs(fitted - look.fitted) < 1e-6
    assert abs(left_out - look.left_out) < 1e-6
    first = next(iter(look.added))
    assert look.added[first] == max(look.added.values(), key=lambda shares: shares[1])
