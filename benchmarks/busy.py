"""Whether threads get in each other's way where other programs use the cores: ``python -m benchmarks.busy [JOB ...]``.

Every edit, two edits in tiles, the operator, the denoiser and steps of training take turns with one thread and with
two, alone and beside one and two processes that keep a core busy each. Threads wait for each other as in the program
(``nlfilter_torch.photo.cli.process``). With two threads nothing must take more than 1.3 times as long as with one, and
alone not more than 1.1 times as long as where threads wait as torch has it, by spinning. Ratios are medians over
``--repeats``. ``--spinning`` shows what spinning costs beside busy processes.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from statistics import median
from typing import Self

import torch
from torch import Tensor, nn

from benchmarks.harness import Figure, options, report, seconds
from benchmarks.photographs import photograph
from benchmarks.streaming import in_tiles
from nlfilter_torch import NonlocalDenoiser, NonlocalFilter, nonlocal_operator, photo, polynomial_filter
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.cli.process import VARIABLES, sleep_while_waiting
from nlfilter_torch.photo.declared.steps import Step

NEIGHBOURS = (0, 1, 2)
BESIDE, IDLE = 1.3, 1.1  # limits of the ratios of times
ENDLESS = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"  # it ends with its parent
Job = Callable[[], object]


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """So many processes that compute without end."""
    started = [subprocess.Popen([sys.executable, "-c", ENDLESS]) for _ in range(count)]
    try:
        time.sleep(0.5 if count else 0.0)  # they are there
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def jobs(side: int) -> dict[str, Job]:
    """Every edit of the astronaut in that size, the operator, and steps of training, by their names."""
    image = nn.functional.interpolate(photograph("astronaut"), (side, side), mode="area")
    region, other = torch.zeros_like(image[:, :1]), torch.zeros_like(image[:, :1])
    region[..., side * 6 // 10 : side * 7 // 10, side // 8 : side // 6] = 1  # on the suit
    other[..., : side // 10, : side // 10] = 1
    colours = torch.tensor([0.1, 0.3, 0.9]).view(1, 3, 1, 1) * region
    noisy = image + 0.06 * torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    grey, small = image.mean(dim=1, keepdim=True), image[..., : side // 2, : side // 2].contiguous()
    look = photo.fit_look([(image[..., ::4, ::4], image[..., ::4, ::4] ** 0.8)])
    alpha, weights = torch.tensor([3.0, 3.0, 4.0, 1.05]), torch.tensor([0.2, 0.5, 1.0, 1.0])
    layer = NonlocalFilter(learn=("alpha", "photometric_bandwidth"), photometric_bandwidth=0.3)
    picture = (255 * image[0].permute(1, 2, 0)).round().byte().numpy()
    features, denoiser = nn.Conv2d(3, 8, 5, padding=2), NonlocalDenoiser.trained()

    def train(network: Callable[[], Tensor]) -> Job:
        return lambda: (network() - small).square().mean().backward()

    return {
        "detail": lambda: photo.enhance(image, alpha),
        "detail of a region": lambda: photo.enhance(image, alpha, region),
        "sharpen": lambda: photo.sharpen(image),
        "tone": lambda: photo.adjust_tone(image, contrast=1.3),
        "denoise": lambda: photo.denoise(noisy),
        "recolor": lambda: photo.recolor(image, colours, region),
        "colorize": lambda: photo.colorize(grey, colours, region),
        "defocus": lambda: photo.defocus(image, region),
        "mask": lambda: region_mask(image, region, other),
        "detail in tiles": lambda: in_tiles(Step("detail", alpha=(3.0, 3.0, 4.0, 1.05)), picture),
        "recolor in tiles": lambda: in_tiles(Step("recolor"), picture),
        "abstract": lambda: photo.abstract(image),
        "look": lambda: look.apply(image),
        "operator": lambda: nonlocal_operator(image),
        "operator and filter": lambda: polynomial_filter(nonlocal_operator(image), image, weights),
        "training step": train(lambda: layer(small, guide=features(small))),
        "denoiser": lambda: denoiser(image, 0.1).detach(),
        "training step of the denoiser": train(lambda: denoiser(small, 0.1)),
    }


def serve(name: str, side: int) -> None:
    """Run a job with as many threads as each line of the standard input says, and print the seconds that it took."""
    job = jobs(side)[name]
    for line in sys.stdin:
        torch.set_num_threads(int(line))
        print(seconds(job), flush=True)


class Runner:
    """A process that runs a job again and again; its threads sleep while they wait, or spin."""

    def __init__(self, name: str, side: int, *, spinning: bool) -> None:
        environment = {key: value for key, value in os.environ.items() if key not in VARIABLES}
        if not spinning:
            environment |= {key: os.environ[key] for key in VARIABLES if key in os.environ}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.busy", name, "--serve", "--side", str(side)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Self:
        """Run the job once with each number of threads: what is compiled or read when it is first needed."""
        for threads in (1, 2):
            self.seconds(threads)
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def seconds(self, threads: int) -> float:
        """The time that the job takes with so many threads."""
        assert self._process.stdin is not None  # for mypy
        assert self._process.stdout is not None
        self._process.stdin.write(f"{threads}\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())


def measure(name: str, options: argparse.Namespace) -> Iterator[Figure]:
    """Figures of a job."""
    ratios: dict[int, list[float]] = {count: [] for count in NEIGHBOURS}
    losses, alone = list[float](), list[float]()
    with ExitStack() as stack:
        runner = stack.enter_context(Runner(name, options.side, spinning=options.spinning))
        other = stack.enter_context(Runner(name, options.side, spinning=True))
        for _ in range(options.repeats):  # before there are neighbours: the scheduler needs a while to forget them
            single, double = runner.seconds(1), runner.seconds(2)
            alone.append(single)
            ratios[0].append(double / single)
            losses.append(double / other.seconds(2))
        for _ in range(options.repeats):
            for count in NEIGHBOURS[1:]:
                with neighbours(count):
                    single, double = runner.seconds(1), runner.seconds(2)
                ratios[count].append(double / single)
    yield Figure(f"{name}: alone with one thread", median(alone), unit="s")
    for count in NEIGHBOURS:
        where = "alone" if count == 0 else f"beside {count}"
        yield Figure(f"{name}: two threads by one, {where}", median(ratios[count]), BESIDE)
    yield Figure(f"{name}: sleeping by spinning, two threads alone", median(losses), IDLE)


def main() -> int:
    """Measure and print figures; return 1 if one falls short of its limit."""
    parser = options("busy", __doc__, "a small picture, once")
    parser.add_argument("jobs", nargs="*", metavar="JOB", help="default: all")
    parser.add_argument("--side", type=int, default=384, help="of the picture in pixels")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--spinning", action="store_true", help="threads wait as torch has it")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.serve:
        serve(chosen.jobs[0], chosen.side)
        return 0
    if chosen.quick:
        chosen.side, chosen.repeats = 48, 1
    sleep_while_waiting()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before", flush=True)
    figures = (figure for name in chosen.jobs or jobs(48) for figure in measure(name, chosen))
    return report(figures, quick=chosen.quick)


if __name__ == "__main__":
    sys.exit(main())
