"""Table I and Fig. 20 of the paper on twelve pictures that ship with scikit-image: ``python -m docs.tables``.

Table I: the share beta (eq. 19) of a picture's energy that its m = 100 eigenvectors capture, at the automatic bandwidth
and at multiples of it. Fig. 20: the residual, as relative RMSE, for increasing m: with the m leading eigenvectors of
150 samples, as in the paper, and with m samples. Both for the paper's own method (uniform samples, no completion) and
for the library's defaults, on grey pictures, long side at most 700.
"""

import argparse
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from nlfilter_torch import captured_energy, estimate_bandwidth, nonlocal_operator
from tests.images import reduced

PICTURES = (
    "astronaut",
    "coffee",
    "chelsea",
    "rocket",
    "camera",
    "hubble_deep_field",
    "retina",
    "brick",
    "grass",
    "gravel",
    "coins",
    "moon",
)
LONG_SIDE = 700
LANDMARKS = 100
MULTIPLES = (0.4, 0.6, 1.0, 1.5, 2.0, 3.0)  # of the automatic bandwidth
COUNTS = (25, 50, 75, 100, 150)  # m of Fig. 20
METHODS: dict[str, dict[str, str]] = {
    "the paper's method (uniform samples, no completion)": {"landmarks": "uniform", "completion": "none"},
    "the library's defaults (k-means, completion)": {},
}
SUFFICIENT = 0.998  # share of energy that counts as sufficient in Table I
ROW_SUMS = 1e-2  # largest deviation of row sums from 1; beyond it the method has failed

PAPER_TABLE_I = """the paper's Table I (beta in %), h_y in units of its own patch weights, 1/4.2 of those of unit sum
h_y                     2       4       6       8      10
Flower              99.95   99.99  100     100     100
Rock                99.83   99.95   99.97   99.98   99.99
Monastery           99.63   99.80   99.88   99.93   99.96"""
PAPER_FIG_20 = """the paper's Fig. 20 is a plot; its text: the error shrinks as m grows, to about 1 % for m > 75"""


@dataclass(frozen=True)
class CapturedEnergy:
    """Energy of the picture captured by the eigenvectors of one operator, and checks of the operator."""

    beta: float
    row_sum_error: float
    largest_eigenvalue: float

    @property
    def finite(self) -> bool:
        """Whether all values are finite."""
        return all(math.isfinite(value) for value in (self.beta, self.row_sum_error, self.largest_eigenvalue))

    @property
    def failed(self) -> bool:
        """Whether the operator is not a doubly stochastic filter."""
        return not (self.finite and self.row_sum_error <= ROW_SUMS and self.largest_eigenvalue <= 1 + ROW_SUMS)

    @property
    def relative_rmse(self) -> float:
        """Relative RMSE in percent (Appendix B): the residual of a projection on orthonormal eigenvectors."""
        return 100 * math.sqrt(max(0.0, 1 - self.beta))


Rows = dict[str, list[CapturedEnergy]]


def picture(name: str, long_side: int = LONG_SIDE) -> torch.Tensor:
    """A grey picture (1, 1, H, W) in float32."""
    return torch.from_numpy(reduced(name, long_side).copy()).float()[None, None]


def measure(
    image: torch.Tensor, bandwidth: float, count: int, options: dict[str, str], rank: int | None = None
) -> CapturedEnergy:
    """Build the operator and project the picture on its eigenvectors, or on the ``rank`` leading ones."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # failed balancing shows in the row sums
        operator = nonlocal_operator(image, photometric_bandwidth=bandwidth, num_landmarks=count, **options)
    spectrum = operator.spectrum(rank)
    return CapturedEnergy(
        captured_energy(spectrum, image).item(),
        (operator.row_sums() - 1).abs().max().item(),
        spectrum.largest.item(),
    )


def auto(image: torch.Tensor) -> float:
    """The automatic bandwidth."""
    return estimate_bandwidth(image).item()


def table_1(
    name: str, long_side: int, options: dict[str, str], multiples: Sequence[float] = MULTIPLES
) -> list[CapturedEnergy]:
    """Beta of one picture at multiples of the automatic bandwidth."""
    image = picture(name, long_side)
    return [measure(image, multiple * auto(image), LANDMARKS, options) for multiple in multiples]


def figure_20(
    name: str, long_side: int, options: dict[str, str], counts: Sequence[int] = COUNTS
) -> list[CapturedEnergy]:
    """Energy captured by the leading eigenvectors of one picture, for increasing numbers of them."""
    image = picture(name, long_side)
    return [measure(image, auto(image), max(counts), options, rank=count) for count in counts]


def growing_samples(
    name: str, long_side: int, options: dict[str, str], counts: Sequence[int] = COUNTS
) -> list[CapturedEnergy]:
    """Energy captured by all eigenvectors of one picture, for increasing numbers of samples."""
    image = picture(name, long_side)
    return [measure(image, auto(image), count, options) for count in counts]


def is_rising(values: Sequence[float]) -> bool:
    """Whether no value is below the previous one by more than half a digit of the table."""
    return all(a <= b + 5e-5 for a, b in pairwise(values))


def print_rows(
    head: Sequence[object], rows: Iterator[tuple[str, list[CapturedEnergy]]], value: Callable[[CapturedEnergy], float]
) -> Rows:
    """Print a table row by row, with ! where the row sums of the filter are off by more than a hundredth."""
    print(f"{'':18}" + "".join(f"{text:>8} " for text in head))
    done = {}
    for name, row in rows:
        done[name] = row
        print(
            f"{name:18}" + "".join(f"{value(captured):8.2f}{'!' if captured.failed else ' '}" for captured in row),
            flush=True,
        )
    return done


def print_table_1(long_side: int, options: dict[str, str]) -> None:
    """Print Table I and a summary."""
    measured = ((name, table_1(name, long_side, options)) for name in PICTURES)
    rows = print_rows([f"{m} auto" for m in MULTIPLES], measured, lambda captured: 100 * captured.beta)
    start = MULTIPLES.index(1.0)
    enough = sum(row[start].beta >= SUFFICIENT and not row[start].failed for row in rows.values())
    rising = sum(is_rising([captured.beta for captured in row[start:]]) for row in rows.values())
    print(
        f"at auto: beta >= {100 * SUFFICIENT:.1f} % on {enough} of {len(rows)}; "
        f"rising from there on {rising} of {len(rows)}"
    )
    for position, multiple in enumerate(MULTIPLES):
        broken = [name for name, row in rows.items() if row[position].failed]
        finite = sum(row[position].finite for row in rows.values())
        told = f"finite on {finite} of {len(rows)}, row sums off on {len(broken)}"
        print(f"at {multiple} auto: {told}" + (f" ({', '.join(broken)})" if broken else ""))


def print_figure_20(long_side: int, options: dict[str, str], measured: Callable[..., list[CapturedEnergy]]) -> None:
    """Print Fig. 20, by eigenvectors or by samples, and a summary."""
    every = ((name, measured(name, long_side, options)) for name in PICTURES)
    rows = print_rows([f"m = {count}" for count in COUNTS], every, lambda captured: captured.relative_rmse)
    falling = sum(is_rising([captured.beta for captured in row]) for row in rows.values())
    print(f"falling with m on {falling} of {len(rows)}")


def main() -> None:
    """Print both tables for both methods, and the paper's own figures."""
    parser = argparse.ArgumentParser(description="Table I and Fig. 20 of the paper on twelve pictures.")
    parser.add_argument("--long-side", type=int, default=LONG_SIDE, help="reduce the pictures to this long side")
    options = parser.parse_args()
    print(PAPER_TABLE_I)
    for name, method in METHODS.items():
        print(f"\nTable I, beta in % at m = {LANDMARKS}: {name}")
        print_table_1(options.long_side, method)
    print("\n" + PAPER_FIG_20)
    for name, method in METHODS.items():
        print(f"\nFig. 20, relative RMSE in % at auto, m eigenvectors of {max(COUNTS)}: {name}")
        print_figure_20(options.long_side, method, figure_20)
        print(f"\nthe same, all eigenvectors of m samples: {name}")
        print_figure_20(options.long_side, method, growing_samples)
    print("\n! = row sums off by more than 0.01")


if __name__ == "__main__":
    main()
