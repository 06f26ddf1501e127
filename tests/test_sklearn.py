"""Estimators of points pass the checks of scikit-learn, and find what they should."""

import numpy as np
import pytest
import torch

pytest.importorskip("sklearn")

from sklearn.datasets import make_blobs
from sklearn.utils.estimator_checks import parametrize_with_checks

from nlfilter_torch import diffusion_map, operator_from_features
from nlfilter_torch.sklearn import DiffusionMap, LabelPropagation


@parametrize_with_checks([DiffusionMap(random_state=0), LabelPropagation(random_state=0)])
def test_conventions(estimator, check):
    check(estimator)


def test_coordinates_are_those_of_the_library() -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    embedding = DiffusionMap(3, bandwidth=2.0, n_landmarks=300, time=0.5).fit(points)
    operator = operator_from_features(torch.from_numpy(points.T.copy())[None] / 2, size=(300,), num_landmarks=300)
    wanted = diffusion_map(operator.spectrum(), time=0.5)[0, :3, 0].mT.numpy()
    np.testing.assert_allclose(np.abs(embedding.transform(points)), np.abs(wanted), atol=1e-6)


def test_labels_extend_to_clusters_and_new_points() -> None:
    points, truth = make_blobs(600, centers=4, cluster_std=0.8, random_state=3)
    given = np.full(600, -1)
    for number in range(4):
        given[np.flatnonzero(truth == number)[:2]] = number
    fitted = LabelPropagation(random_state=0).fit(points[:500], given[:500])
    assert (fitted.transduction_ == truth[:500]).mean() > 0.97
    assert (fitted.predict(points[500:]) == truth[500:]).mean() > 0.95
    np.testing.assert_allclose(fitted.predict_proba(points).sum(1), 1)


def test_labels_that_do_not_find_one_another_cause_a_warning() -> None:
    random = np.random.default_rng(0)
    told = np.full(1200, -1)
    told[:40] = np.arange(40) % 4
    points = random.standard_normal((1200, 20))
    with pytest.warns(UserWarning, match="^y must be classes of which W links the points, got ones of which it finds"):
        LabelPropagation(random_state=0, n_landmarks=50).fit(points, told)
    points[:, 0] += 30 * (np.arange(1200) % 4)
    LabelPropagation(random_state=0, n_landmarks=50).fit(points, told)
