"""Choosing the parts of a look, and least squares with bounds."""

import math

import pytest
import torch
from scipy.optimize import lsq_linear

from nlfilter_torch.photo import fit_look
from nlfilter_torch.photo.looks.look_choice import CHOICES, Candidate, fit_parts, simplest
from nlfilter_torch.photo.looks.look_sums import PartLayout, Parts, columns_of, sums_of
from tests.looks import CAT, FEW, in_bytes, single_look


@pytest.mark.parametrize("parts", [("tone",), ("curves",)])
def test_no_curve_that_does_not_fall_explains_more(parts: Parts) -> None:
    layout = PartLayout(knots=6, factors=2, sliders=2)
    image = torch.rand(3, 500, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    columns = columns_of(image, torch.zeros(3, 7 + 6 + 3 + 8 + 2, 500), layout)
    sums = sums_of(columns, 0.4 * torch.sin(9 * image), torch.ones_like(image))
    place = layout.place("curves")
    changes = fit_parts(sums, parts, layout, 0.0)[:, place]
    assert float((torch.linspace(0, 1, 6, dtype=torch.float64) + changes).diff().min()) > -1e-8
    groups = [slice(3)] if parts == ("tone",) else [slice(c, c + 1) for c in range(3)]
    for channels in groups:
        gram, cross = sums.gram[channels, place, place].sum(0), sums.cross[channels, place].sum(0)
        root = torch.linalg.cholesky(gram)
        steps = torch.ones(6, 6, dtype=torch.float64).tril()  # from rises to a curve
        target = torch.linalg.solve_triangular(root, cross.unsqueeze(1), upper=False).squeeze(1)
        least = [-math.inf, *[-0.2] * 5]
        rises = lsq_linear((root.mT @ steps).numpy(), target.numpy(), (least, math.inf), tol=1e-12).x
        torch.testing.assert_close(changes[channels][0], steps @ torch.from_numpy(rises), rtol=0, atol=1e-6)


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
