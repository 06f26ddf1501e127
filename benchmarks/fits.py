"""Whether fits of a layer agree, wherever they start: ``python -m benchmarks.fits``.

Sliders and both bandwidths are fitted to detail that another filter enhanced, from five photometric bandwidths that lie
a factor of 100 apart, with at most 300 evaluations each, and compared with a grid of 15x12 bandwidths, at each of which
``fit_alpha`` gives the sliders. Pictures of 64x64 pixels, grey.
"""

import sys
from collections.abc import Iterator, Sequence

import torch
from kornia.filters import bilateral_blur, guided_blur
from torch import Tensor

from benchmarks.harness import Figure, options, report
from benchmarks.photographs import REPORTING, photograph
from nlfilter_torch import NonlocalFilter, fit_alpha, fit_layer, nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.features import reduce_channels

SIDE, LANDMARKS = 64, 60
STARTS = (0.01, 0.03, 0.1, 0.3, 1.0)
EVALUATIONS, MOST = 300, 1.2
SPATIAL = 5.0
FILTERS = {
    "bilateral": lambda image: bilateral_blur(image, (11, 11), 0.1, (3.0, 3.0)),
    "guided": lambda image: guided_blur(image, image, (9, 9), 0.01),
}


def grid(image: Tensor, target: Tensor, steps: tuple[int, int]) -> float:
    """The least error over a grid of bandwidths, in grey levels."""
    best = float("inf")
    for photometric in torch.logspace(-2.5, 0.5, steps[0]).tolist():
        for spatial in torch.logspace(-0.2, 1.8, steps[1]).tolist():
            operator = nonlocal_operator(
                image, photometric_bandwidth=photometric, spatial_bandwidth=spatial, num_landmarks=LANDMARKS
            )
            alpha = fit_alpha(operator, image, target, rounding=0.0)[0]
            best = min(best, levels(polynomial_filter(operator, image, alpha) - target))
    return best


def levels(difference: Tensor) -> float:
    """Root mean square in grey levels."""
    return 255 * float(difference.square().mean().sqrt())


def measure(names: Sequence[str], quick: bool) -> Iterator[Figure]:
    """The worst of five fits for each picture and filter, relative to the grid."""
    for name in names[: 1 if quick else None]:
        image = reduce_channels(photograph(name, SIDE, SIDE), "luminance")
        for method, blur in FILTERS.items():
            target = image + 1.5 * (image - blur(image))
            least = grid(image, target, (3, 2) if quick else (15, 12))
            errors = []
            for start in STARTS[:: 4 if quick else 1]:
                layer = NonlocalFilter(
                    photometric_bandwidth=start,
                    spatial_bandwidth=SPATIAL,
                    num_landmarks=LANDMARKS,
                    learn=("alpha", "photometric_bandwidth", "spatial_bandwidth"),
                )
                found = fit_layer(layer, image, target, evaluations=60 if quick else EVALUATIONS)
                with torch.no_grad():
                    errors.append(levels(layer(image) - target))
                print(
                    f"  {name}, {method}, from {start:g}: {errors[-1]:.3f} levels, {found.evaluations} evaluations, "
                    f"h_y {float(found.photometric_bandwidth):.4g}, h_x {found.spatial_bandwidth or 0:.3g}, alpha "
                    + " ".join(f"{value:.2f}" for value in found.alpha)
                )
            yield Figure(f"{name}, {method}: error of the grid", least, unit="levels")
            yield Figure(f"{name}, {method}: worst fit relative to the grid", max(errors) / least, MOST)


def main() -> int:
    """Command line."""
    parser = options("fits", __doc__, "two starts on one picture")
    parser.add_argument(
        "names", nargs="*", default=REPORTING, help="photographs of scikit-image (default: %(default)s)"
    )
    arguments = parser.parse_args()
    return report(measure(arguments.names, arguments.quick), quick=arguments.quick)


if __name__ == "__main__":
    sys.exit(main())
