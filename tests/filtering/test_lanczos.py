"""The method of Lanczos against the dense eigen-decomposition."""

import pytest
import torch

from nlfilter_torch import nonlocal_operator, operator_from_features
from nlfilter_torch.filtering.lanczos import Lanczos, krylov_product, ritz_space
from nlfilter_torch.operator.pixel_matrix import PixelMatrix
from tests.problems import noise, picture


def matrix(batch: int = 1) -> PixelMatrix:
    guide = torch.cat([picture(name, 20, 24) for name in ("camera", "coffee")])[:batch]
    operator = nonlocal_operator(guide, num_landmarks=30, photometric_bandwidth=0.1)
    return operator.matrix


def dense_of(matrix: PixelMatrix) -> torch.Tensor:
    unit = torch.eye(matrix.factor.shape[2], dtype=matrix.factor.dtype)
    return matrix.product(unit.expand(len(matrix.factor), -1, -1))


def test_the_basis_is_orthonormal_and_w_is_tridiagonal_in_it() -> None:
    for weights in (None, noise(1, 30, seed=3) + 0.3):
        operator = operator_from_features(noise(1, 2, 30), size=(30,), num_landmarks=8, weights=weights)
        w = operator.matrix
        iteration = Lanczos(w, noise(1, 2, 30, seed=1))
        iteration.extend(4)
        iteration.extend(3)
        space = iteration.space()
        basis = space.basis[0]
        mass = 1.0 if weights is None else weights
        torch.testing.assert_close((mass * basis) @ basis.mT, torch.eye(7, dtype=torch.float64).expand(2, -1, -1))
        projected = (mass * basis) @ dense_of(w)[0].mT.mT @ basis.mT if weights is None else None
        if projected is not None:
            rebuilt = (space.vectors[0] * space.values[0].unsqueeze(1)) @ space.vectors[0].mT
            torch.testing.assert_close(projected, rebuilt, atol=1e-12, rtol=0)


def test_an_exhausted_space_is_exact() -> None:
    """A constant image is an eigenvector: one step suffices, and further ones change nothing."""
    w = matrix()
    ones = torch.ones(1, 1, 480, dtype=torch.float64)
    space, error = ritz_space(w, torch.cat([ones, 0 * ones], dim=1), torch.reciprocal, 1e-6)
    assert error < 1e-3
    result = krylov_product(w, torch.cat([ones, 0 * ones], dim=1), torch.reciprocal, space)
    torch.testing.assert_close(result, torch.cat([ones, 0 * ones], dim=1), atol=1e-3, rtol=0)


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("step", [0.9, 0.4])
def test_kinks_are_those_of_the_dense_matrix(step: float, batch: int) -> None:
    w, planes = matrix(batch), noise(batch, 3, 480, seed=1)

    def response(values: torch.Tensor) -> torch.Tensor:
        return (values - step).relu()

    space, error = ritz_space(w, planes, response, 1e-4)
    dense = dense_of(w)
    values, vectors = torch.linalg.eigh((dense + dense.mT) / 2)
    wanted = planes @ ((vectors * response(values).unsqueeze(1)) @ vectors.mT)
    assert error <= 1e-4
    assert (krylov_product(w, planes, response, space) - wanted).abs().max() < 2e-4


@pytest.mark.parametrize("weighted", [False, True])
def test_gradients(weighted: bool) -> None:
    weights = noise(1, 20, seed=3) + 0.3 if weighted else None
    leaves = noise(1, 2, 20), noise(1, 2, 20, seed=1), torch.tensor(0.37, dtype=torch.float64)
    leaves = tuple(leaf.clone().requires_grad_() for leaf in leaves)

    def product(features: torch.Tensor, planes: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        operator = operator_from_features(features, size=(20,), num_landmarks=6, weights=weights, landmarks="uniform")
        parts = operator.factor, operator.scaling, operator.remainder
        w = PixelMatrix(*parts, weights)

        def response(values: torch.Tensor) -> torch.Tensor:
            return (values - step).relu() + step * values

        space, _ = ritz_space(w, planes.detach(), response, 1e-12)
        return krylov_product(w, planes, response, space)

    assert torch.autograd.gradcheck(product, leaves, atol=1e-6)
