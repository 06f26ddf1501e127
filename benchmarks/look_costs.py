"""What fitting and applying looks takes: ``python -m benchmarks.look_costs [--megapixels 1] [--pairs 100]``.

Processor and wall seconds of one pair edited by Pillow, and by sliders of this library, which are to be found to 1e-3
through 8 bits; then processor time of applying looks with and without lattices of colours; then the most memory that
one pair needs, and that many pairs need, beyond what the process has at the start. The photograph is scikit-image's
cat, enlarged, and shifted for each of many pairs. Linux only.
"""

from collections.abc import Callable, Iterator
from functools import partial

import torch
from torch import Tensor

from benchmarks.harness import options, peak, seconds
from benchmarks.looks import EDITS, applied
from benchmarks.photographs import enlarged
from nlfilter_torch.core.kernels import definitions_only
from nlfilter_torch.photo import apply_look, fit_look
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.looks.look_filter import lattice_change

ALPHA = (2.2, 1.6, 1.3, 1.02)
SLIDERS = "sliders of this library"
NAMES = ("gamma (scikit-image)", "unsharp (Pillow)", "CLAHE (OpenCV)", SLIDERS)


def edited(name: str, image: Tensor) -> Tensor:
    """A photograph (1, 3, H, W) in 8 bits under an edit."""
    if name != SLIDERS:
        return applied(EDITS[name], image)
    step = Step("detail", alpha=ALPHA, limits="none", threshold=0.0)
    return (apply_step(step, image).clamp(0, 1) * 255).round() / 255


def told(name: str, image: Tensor, repeats: int) -> str:
    """How long a look takes, the least of some times, and how exact sliders are."""
    pairs = [(image, edited(name, image))]
    taken = [
        (seconds(lambda: fit_look(pairs), processor=True), seconds(lambda: fit_look(pairs))) for _ in range(repeats)
    ]
    processor, wall = (min(times) for times in zip(*taken, strict=True))
    line = f"{name:26}{processor:6.2f} processor s {wall:6.2f} wall s"
    look = fit_look(pairs)
    if name != SLIDERS or isinstance(look, tuple):
        return line
    error = (torch.tensor(look.step["alpha"]) - torch.tensor(ALPHA)).abs().max()
    return f"{line}, alpha off by {float(error):.1e} at most"


def least(function: Callable[[], object], repeats: int) -> float:
    """The least processor time in ms of some calls, after a first one."""
    function()
    return 1000 * min(seconds(function, processor=True) for _ in range(repeats))


def with_lattices(image: Tensor, repeats: int) -> Iterator[str]:
    """How long a look takes without a lattice, with lattices of some numbers of nodes, and these alone."""
    megapixels = image[0, 0].numel() / 1e6
    parts = {"red": (0.0, 0.2, 0.5, 1.0), "green": (0.0, 0.25, 0.5, 1.0), "blue": (0.0, 0.3, 0.6, 1.0)}
    without = partial(apply_look, image, saturation=(1.2, 1.1, 1.0, 1.0, 1.1, 1.2), **parts)
    for nodes in (9, 17, 33):
        lattice = 0.05 * torch.rand(3, *[nodes] * 3, generator=torch.Generator().manual_seed(0))
        plain, whole = least(without, repeats), least(partial(without, lattice=lattice), repeats)
        alone = partial(lattice_change, image, lattice)
        own = least(alone, repeats)
        with definitions_only():
            by_torch = least(alone, 2)
        yield (
            f"lattice of {nodes:2d}^3: {own / megapixels:5.2f} ms a megapixel, by torch {by_torch / megapixels:5.1f}; "
            f"look without {plain / megapixels:5.1f}, with {whole / megapixels:5.1f}, {whole / plain:.2f} times"
        )


def shifted(image: Tensor, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs, one at a time."""
    for number in range(count):
        moved = image.roll(7 * number, 3)
        yield moved, edited("gamma (scikit-image)", moved)


def cat(megapixels: float) -> Tensor:
    """The cat in another size and in 8 bits, (1, 3, H, W), 3:2."""
    height = round((megapixels * 1e6 / 1.5) ** 0.5)
    return (enlarged("chelsea", height, round(1.5 * height)) * 255).round() / 255


def main() -> None:
    """Print the table."""
    parser = options("look_costs", __doc__, "small pictures, and few of them")
    parser.add_argument("--megapixels", type=float, default=1.0, help="of the pair that is timed")
    parser.add_argument("--pairs", type=int, default=100, help="that memory is measured with")
    parser.add_argument("--small", type=float, default=0.1, help="megapixels of these")
    parser.add_argument("--repeats", type=int, default=3, help="of each time, of which the least is printed")
    chosen = parser.parse_args()
    if chosen.quick:
        chosen.megapixels, chosen.pairs, chosen.small, chosen.repeats = 0.005, 2, 0.005, 1
    image, small = cat(chosen.megapixels), cat(chosen.small)
    fit_look([(image, image**0.9)])  # loads what is loaded once
    for name in NAMES:
        print(told(name, image, chosen.repeats), flush=True)
    for line in with_lattices(image, 5 * chosen.repeats):
        print(line, flush=True)
    fit_look(shifted(small, 1))
    for count in (1, chosen.pairs):
        memory = peak(lambda: fit_look(shifted(small, count)))  # noqa: B023
        print(f"{count:4d} pairs of {chosen.small:g} megapixels: {memory:7.1f} MiB", flush=True)


if __name__ == "__main__":
    main()
