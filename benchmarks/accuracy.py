"""How far results of the approximate filter are from those of the dense one: ``python -m benchmarks.accuracy``.

RMS difference of W y in grey levels between the library in float64 and :mod:`tests.reference`, on photographs reduced
to 72x72, 5x5 patches, m = 100. The paper's own method appears twice: as implemented in the reference, and as the
library with uniform samples and no completion.
"""

import warnings
from dataclasses import dataclass

import numpy as np
import torch

from nlfilter_torch import nonlocal_operator
from tests import reference
from tests.images import photograph

PICTURES = ("astronaut", "camera", "chelsea", "coffee")
SIDE = 72
LANDMARKS = 100
LIMITS = {10: 2.0, 20: 2.5, 40: 0.8}  # bandwidth in grey levels: largest error allowed to the default method


@dataclass(frozen=True)
class Errors:
    """RMS errors of W y in grey levels, for one picture and bandwidth."""

    picture: str
    bandwidth: int
    paper: float
    plain: float
    uniform: float
    default: float

    @property
    def holds(self) -> bool:
        """Whether the default's error is within its limit and at most half of that of the paper's own method."""
        return self.default <= LIMITS[self.bandwidth] and self.default <= min(self.paper, self.plain) / 2


def measure(picture: str, bandwidth: int) -> Errors:
    """Compare every method with the dense filter."""
    image = photograph(picture, SIDE, SIDE)
    h_y = bandwidth / 255
    exact = reference.filter_matrix(image, 5, h_y) @ image.ravel()

    def error(estimate: np.ndarray) -> float:
        return float(255 * np.sqrt(np.mean((estimate.ravel() - exact) ** 2)))

    def library(**options: str) -> np.ndarray:
        y = torch.from_numpy(image.copy())[None, None]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # without completion the library warns about row sums
            operator = nonlocal_operator(y, photometric_bandwidth=h_y, num_landmarks=LANDMARKS, **options)
        return (operator @ y).numpy()

    s, v = reference.nystrom_eigenpairs(
        reference.features(image, 5, h_y), reference.uniform_samples(SIDE, SIDE, LANDMARKS)
    )
    return Errors(
        picture,
        bandwidth,
        paper=error(reference.spectral_function(s, v, s, image.ravel())),
        plain=error(library(landmarks="uniform", completion="none")),
        uniform=error(library(landmarks="uniform")),
        default=error(library()),
    )


def main() -> None:
    """Print the table."""
    print(f"RMS error of W y in grey levels, {SIDE}x{SIDE}, m = {LANDMARKS}, float64")
    print(f"{'picture':10} {'h':>3} {'paper':>7} {'plain':>7} {'uniform':>8} {'default':>8} {'limit':>6}")
    print(f"{'':10} {'':>3} {'numpy':>7} {'library':>7} {'completed':>9} {'kmeans':>7}")
    rows = [measure(picture, bandwidth) for picture in PICTURES for bandwidth in LIMITS]
    for row in rows:
        print(
            f"{row.picture:10} {row.bandwidth:3d} {row.paper:7.2f} {row.plain:7.2f} {row.uniform:8.2f} "
            f"{row.default:8.2f} {LIMITS[row.bandwidth]:6.1f} {'holds' if row.holds else 'FALLS SHORT'}"
        )
    print(f"{sum(row.holds for row in rows)} of {len(rows)} within the limit and at most half of the paper's own error")


if __name__ == "__main__":
    main()
