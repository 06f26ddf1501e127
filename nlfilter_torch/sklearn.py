"""The filter of points as estimators of scikit-learn, which is optional: ``pip install nlfilter-torch[sklearn]``.

W links the rows of a table by ``exp(-|x_i - x_j|^2 / h^2)``, through landmarks, in time proportional to their number.
Points that it was not fitted to are linked by their own affinities to the landmarks.
"""

from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin, TransformerMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, check_random_state, validate_data
from torch import Tensor

from nlfilter_torch.core.warning import warn
from nlfilter_torch.filtering.labels import LABEL_STRENGTH, NO_LABEL, propagate_labels, shares
from nlfilter_torch.operator.build import operator_from_points
from nlfilter_torch.operator.neighbours import NEIGHBOURS, bandwidth_of_points
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.traps import LEAST_POINTS

Array = NDArray[Any]

# Of the estimated bandwidth, for labels: of 1, 0.75, 0.55, 0.4 the best in the mean of scikit-learn's tables of wines
# and of breast cancer, with five labels a class.
BANDWIDTH_SHARE = 0.55
LEAST_LABELS, LEAST_FOUND = 4, 0.75  # of a class in the mean; share of the labels, below which there is a warning
LABEL_LANDMARKS = 400  # more are right more often where classes have many shapes, and take a second for 10,000 points


class _Linked(BaseEstimator):  # type: ignore[misc]
    """What both estimators share: W of the rows of a table.

    Args:
        bandwidth: h, in units of the features; None is that at which a point has ``n_neighbors``.
        n_neighbors: sum of the affinities of a point to all others, see :func:`~nlfilter_torch.bandwidth_of_points`.
        n_landmarks: M; all points where there are fewer.
        random_state: seed of the choice of landmarks.
    """

    def _link(self, table: Array, factor: float = 1.0) -> NonlocalOperator:
        points = _points(table)
        self.bandwidth_ = self.bandwidth
        if self.bandwidth is None:
            self.bandwidth_ = factor * float(bandwidth_of_points(points, self.n_neighbors)) if len(table) > 1 else 1.0
        seed = int(check_random_state(self.random_state).randint(2**31 - 1))
        count = min(self.n_landmarks, len(table))
        options = FilterOptions(num_landmarks=count, generator=torch.Generator().manual_seed(seed))
        self.operator_ = operator_from_points(points / self.bandwidth_, (len(table),), options)
        return self.operator_

    def _columns(self, table: Any) -> Any:
        check_is_fitted(self)
        table = validate_data(self, table, dtype=np.float64, reset=False)
        return self.operator_.at(_points(table) / self.bandwidth_)


def _points(table: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(table.T))[None]


class DiffusionMap(TransformerMixin, _Linked):  # type: ignore[misc]
    """Embedding by the eigenvectors of W, scaled by ``lambda^time``; see :func:`~nlfilter_torch.diffusion_map`.

    Args:
        n_components: coordinates, without the constant one; 0 beyond the rank of W.
        time: larger values keep only coarse structure.
        bandwidth: h, in units of the features; None is that at which a point has ``n_neighbors``.
        n_neighbors: sum of the affinities of a point to all others, see :func:`~nlfilter_torch.bandwidth_of_points`.
        n_landmarks: M; all points where there are fewer.
        random_state: seed of the choice of landmarks.

    Attributes:
        operator_: W of the points.
        eigenvalues_: (n_components,).
        bandwidth_: h.
    """

    def __init__(
        self,
        n_components: int = 2,
        *,
        time: float = 1.0,
        bandwidth: float | None = None,
        n_neighbors: int = NEIGHBOURS,
        n_landmarks: int = FilterOptions.num_landmarks,
        random_state: Any = None,
    ) -> None:
        self.n_components = n_components
        self.time = time
        self.bandwidth = bandwidth
        self.n_neighbors = n_neighbors
        self.n_landmarks = n_landmarks
        self.random_state = random_state

    def fit(self, X: Any, y: Any = None) -> Self:
        """Build W of the rows of X and its eigenvectors."""
        table = validate_data(self, X, dtype=np.float64, ensure_min_samples=2)
        self.spectrum_ = self._link(table).spectrum()
        values = np.zeros(self.n_components)
        found = self.spectrum_.eigenvalues[0, 1 : self.n_components + 1].numpy()
        values[: len(found)] = found
        self.eigenvalues_ = values
        return self

    def transform(self, X: Any) -> Array:
        """Coordinates (n, n_components) of the rows of X, fitted ones or new ones."""
        columns = self._columns(X)
        vectors = self.spectrum_.eigenvectors_at(columns)[0, 1 : self.n_components + 1].mT.numpy()
        embedding = np.zeros((len(vectors), self.n_components))
        scale = self.eigenvalues_**self.time * self.operator_.factor.shape[2] ** 0.5
        embedding[:, : vectors.shape[1]] = vectors * scale[: vectors.shape[1]]
        return embedding


class LabelPropagation(ClassifierMixin, _Linked):  # type: ignore[misc]
    """Classes of a few points extended to all; see :func:`~nlfilter_torch.propagate_labels`.

    Points of unknown class have the label -1, as in scikit-learn.

    Args:
        strength: how far labels extend. Of 1,024 points or more, a warning tells if the labels do not find one another.
        bandwidth: h, in units of the features; None is 0.55 of that at which a point has ``n_neighbors``.
        n_neighbors: sum of the affinities of a point to all others, see :func:`~nlfilter_torch.bandwidth_of_points`.
        n_landmarks: M; all points where there are fewer.
        random_state: seed of the choice of landmarks.

    Attributes:
        classes_: (K,).
        label_distributions_: probabilities (n, K) of the fitted points.
        transduction_: classes (n,) of the fitted points.
        operator_: W of the points.
    """

    def __init__(
        self,
        *,
        strength: float = LABEL_STRENGTH,
        bandwidth: float | None = None,
        n_neighbors: int = NEIGHBOURS,
        n_landmarks: int = LABEL_LANDMARKS,
        random_state: Any = None,
    ) -> None:
        self.strength = strength
        self.bandwidth = bandwidth
        self.n_neighbors = n_neighbors
        self.n_landmarks = n_landmarks
        self.random_state = random_state

    def fit(self, X: Any, y: Any) -> Self:
        """Build W of the rows of X, and extend the classes y, where these are not -1."""
        table, given = validate_data(self, X, y, dtype=np.float64)
        check_classification_targets(given)
        known = given != -1 if given.dtype.kind in "iuf" else np.ones(len(given), bool)
        self.classes_, numbers = np.unique(given[known], return_inverse=True)
        labels = torch.full((1, len(given)), -1)
        labels[0, torch.from_numpy(known)] = torch.from_numpy(numbers)
        operator = self._link(table, BANDWIDTH_SHARE)
        found = propagate_labels(operator, labels, strength=self.strength)
        self.label_distributions_ = found[0].mT.numpy()
        self.transduction_ = self.classes_[self.label_distributions_.argmax(1)]
        self._sums = self.operator_.matrix.sums(found)
        if len(table) >= LEAST_POINTS and known.sum() >= LEAST_LABELS * len(self.classes_):
            self._warn_of_labels(labels)
        return self

    def _warn_of_labels(self, labels: Tensor) -> None:
        """Warn if many of the known labels (1, N) are not found from the others."""
        places = (labels[0] >= 0).nonzero()[:, 0]
        apart = places[labels[0, places].argsort(stable=True)][::2]  # half of each class
        others = labels.clone()
        others[0, apart] = NO_LABEL
        found = propagate_labels(self.operator_, others, strength=self.strength)[0].argmax(0)
        share = float((found[apart] == labels[0, apart]).double().mean())
        if share < LEAST_FOUND:
            warn(
                f"y must be classes of which W links the points, got ones of which it finds {share:.0%} of the labels "
                "from the other half; label more points, choose bandwidth, or take a graph of nearest neighbours"
            )

    def predict_proba(self, X: Any) -> Array:
        """Probabilities (n, K) of the classes of the rows of X, fitted ones or new ones."""
        columns = self._columns(X)
        return shares(columns.spread(self._sums))[0].mT.numpy()

    def predict(self, X: Any) -> Array:
        """Classes (n,) of the rows of X, fitted ones or new ones."""
        probabilities = self.predict_proba(X)
        return self.classes_[probabilities.argmax(1)]
