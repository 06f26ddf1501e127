"""Whether the contraction factor of the prior keeps what it says, on random problems: ``python -m benchmarks.prior``.

Each problem is a crop of 12x12 pixels, a blur, a mask of known pixels or a subsampling by two, and a prior of either
form, with strengths from 0.01 to 100 and steps of any legal length; half of them are in float32. The factor is computed
before the first step and compared with the dense eigenvalues, and with what 20 steps contract.
"""

import sys

import torch

from benchmarks.harness import Figure, options, report
from tests.inverse_problems import KINDS, random_problem

PROBLEMS, QUICK = 1000, 12
STEPS = 20
NEAR = 0.05


def measure(seeds: range) -> list[Figure]:
    """Figures over the problems of these seeds."""
    count = len(seeds)
    exceeded, too_low, gaps, norms, products = 0, 0, list[float](), list[float](), list[int]()
    kinds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for seed in seeds:
        problem = random_problem(seed)
        found, truth = problem.promised, problem.truth()
        factor = float(found.factor)
        gaps.append(factor - truth.factor)
        kinds[problem.kind].append(gaps[-1])
        norms.append(float(found.squared_norm) / truth.squared_norm)
        too_low += gaps[-1] < -problem.rounding or norms[-1] < 1 - problem.rounding
        exceeded += max(problem.measured_factors(STEPS), default=0.0) > factor + problem.rounding
        products.append(found.products)
    near = sum(gap <= NEAR for gap in gaps) / count
    return [
        Figure(f"problems of {count} in which a step contracted less than promised", exceeded, 0),
        Figure("problems in which the factor or the norm is below the dense one", too_low, 0),
        Figure(f"share of factors within {NEAR} of the dense one", near, 0.95, at_most=False),
        Figure("largest distance of a factor from the dense one", max(gaps)),
        *(Figure(f"largest distance, {kind}", max(values)) for kind, values in kinds.items()),
        Figure("largest bound of |A|^2 relative to the dense one", max(norms)),
        Figure("products with A and its transpose, median", float(torch.tensor(products).median())),
    ]


def main() -> int:
    """Command line."""
    parser = options("prior", __doc__, "some problems")
    parser.add_argument("--problems", type=int, default=PROBLEMS, help="number of problems (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first problem (default: %(default)s)")
    arguments = parser.parse_args()
    count = QUICK if arguments.quick else arguments.problems
    return report(measure(range(arguments.first, arguments.first + count)), quick=arguments.quick)


if __name__ == "__main__":
    sys.exit(main())
