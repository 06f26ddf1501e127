"""The steps of the training, which can be stopped and resumed."""

import csv
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from safetensors.torch import save as as_bytes
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from benchmarks.training.examples import SHARES, Batches, Examples, Source
from benchmarks.training.graphs import graphed_pivots
from benchmarks.training.pictures import Pictures
from nlfilter_torch.nn.denoiser.network import PLANES, SLOPE, WIDTH, Layer, NonlocalDenoiser, shapes_of
from nlfilter_torch.nn.denoiser.weights import read_weights
from nlfilter_torch.photo.files.writing import open_beside
from nlfilter_torch.photo.plotting import save_figure

BATCH = 6  # crops in a step
SIDE, RIM = 80, 8  # pixels of a crop, and of its border, in which errors do not count: tiles are blended there
RATE = 2e-3  # of Muon, for the kernels of the convolutions
ADAM_RATE = 0.5  # of Adam, for all other weights, relative to that of Muon
BANDWIDTH_RATE = 2.5  # of Adam, for bandwidths, which are scalars learned as logarithms, likewise
EXPECTED = 0.55  # exponent with which the error of a denoiser grows with the noise
WARM_UP = 200  # steps over which the learning rate rises
FALL = 0.7  # final share of the steps, over which the learning rate falls to zero along half a cosine
EXACT = 0.3  # final share of the steps with convolutions in float32, where the others have bfloat16
LARGEST_GRADIENT = 0.5  # norm to which gradients are clipped
LATE = 10  # the running mean of the weights is over the last 1/LATE of the steps, about
EVERY = 250  # steps between checkpoints
PREFETCHED = 4  # batches that each process makes ahead
ASIDE, ASIDE_SEED = 16, 1_000_000  # examples of each kind set aside for judging, and their seed


class PlainDenoiser(NonlocalDenoiser):
    """The denoiser without the filter: a convolution, with more weights, in place of guide and sliders."""

    def __init__(self) -> None:
        super().__init__()
        del self.log_bandwidths
        self.guide = Layer(WIDTH, WIDTH)
        self.picture = nn.Conv2d(WIDTH, PLANES, 1)
        self.register_buffer("log_bandwidths", torch.zeros(2), persistent=False)

    def smooth(self, features: Tensor, planes: Tensor, pixels: int) -> Tensor:
        """Estimate the smoothed planes by convolutions."""
        change: Tensor = self.picture(F.leaky_relu(self.guide(features), SLOPE))
        return planes + change.to(planes)


@dataclass(frozen=True)
class Plan:
    """What a training does; a resumed one must have the same plan, but for the number of steps.

    Attributes:
        steps: in all.
        rate: of Muon, for kernels of convolutions; those of Adam are in proportion.
        seed: of crops and noise, and of weights that are drawn.
        plain: whether to train the network without the filter.
        half: whether convolutions run in bfloat16, but for the last :data:`EXACT` of the steps.
        side: of crops, in pixels.
        start: file of the initial weights; None draws them.
        batch: crops in a step.
        parts: crops from each photograph by a simulated camera.
        device: on which the network is trained.
        workers: processes that make examples; with none, the training makes them itself.
    """

    steps: int
    rate: float = RATE
    seed: int = 0
    plain: bool = False
    half: bool = False
    side: int = SIDE
    start: Path | None = None
    batch: int = BATCH
    parts: int = 1
    device: str = "cpu"
    workers: int = 0


def errors(image: Tensor, clean: Tensor) -> Tensor:
    """Root mean squared error of each crop, in grey levels."""
    return 255 * ((image - clean).square().mean((1, 2, 3)) + 1e-8).sqrt()


def loss_of(denoised: Tensor, clean: Tensor, noisy: Tensor) -> Tensor:
    """Mean error of crops relative to the error expected for their noise, so that weak noise counts equally."""
    return (errors(denoised, clean) / (1 + errors(noisy, clean)) ** EXPECTED).mean()


def rate_at(step: int, steps: int) -> float:
    """Learning rate at a step, relative to the full rate."""
    if step < WARM_UP:
        return (step + 1) / WARM_UP
    passed = max(0.0, (step / steps - (1 - FALL)) / FALL)
    return 0.5 + 0.5 * float(torch.cos(torch.tensor(torch.pi * min(1.0, passed))))


@torch.no_grad()
def average_late(means: Sequence[Tensor], weights: Sequence[Tensor], number: Tensor | int) -> None:
    """Update running means of weights after so many steps; the weight of step n is proportional to n ** (LATE - 1)."""
    for mean, weight in zip(means, weights, strict=True):
        mean.lerp_(weight, LATE / (LATE + float(number)))


def new_denoiser(plan: Plan) -> NonlocalDenoiser:
    """Create a denoiser with weights drawn from a seed, or read from a file."""
    with torch.random.fork_rng(devices=[]):  # layers draw their weights from the global generator
        torch.manual_seed(plan.seed)
        model = PlainDenoiser() if plan.plain else NonlocalDenoiser()
    if plan.start is not None:
        model.load_state_dict(read_weights(plan.start, shapes_of(model)))
    return model.to(plan.device, memory_format=torch.channels_last)


class Training:
    """A training that can be stopped and resumed.

    Args:
        plan: of the training.
        pictures: for training.
        aside: pictures for judging.
    """

    def __init__(self, plan: Plan, pictures: Pictures, aside: Pictures) -> None:
        self.plan, self.model = plan, new_denoiser(plan)
        self.mean = AveragedModel(self.model, multi_avg_fn=average_late)
        named = {name: weight for name, weight in self.model.named_parameters() if weight.requires_grad}
        bandwidths = [named.pop("log_bandwidths")] if "log_bandwidths" in named else []
        self.kernels = [
            (weight, _as_matrix(weight)) for weight in named.values() if weight.ndim == 4 and len(weight) > PLANES
        ]
        others = [weight for weight in named.values() if weight.ndim == 1 or len(weight) <= PLANES]
        matrices = [matrix for _, matrix in self.kernels]
        self.optimizers = [
            torch.optim.Muon(matrices, lr=plan.rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
            torch.optim.Adam([{"params": others}, {"params": bandwidths}], lr=plan.rate),
        ]
        self.rates = (plan.rate, ADAM_RATE * plan.rate, BANDWIDTH_RATE * plan.rate)
        self.batches = Batches(pictures, plan.side, plan.seed, plan.batch, plan.parts)
        judged = Source(aside, plan.side, ASIDE_SEED, exact=True)
        self.aside = {
            f"{kind}, {colours}": judged.batch(ASIDE, grey=colours == "grey", kind=kind).to(plan.device)
            for kind in SHARES
            for colours in ("grey", "colour")
        }
        self.number = 0
        self.losses: list[Tensor] = []  # since the last checkpoint
        self.curve: list[dict[str, float]] = []
        self.seconds = 0.0

    def denoise(self, model: nn.Module, examples: Examples) -> Tensor:
        """Denoise crops as in training."""
        half = self.plan.half and self.number < (1 - EXACT) * self.plan.steps
        with torch.autocast(torch.device(self.plan.device).type, torch.bfloat16, enabled=half):
            noise: Tensor = model.estimate_noise(examples.noisy, examples.levels)  # type: ignore[operator]
        return examples.noisy - noise

    def step(self, examples: Examples) -> None:
        """Train one step with a batch of examples."""
        groups = [group for optimizer in self.optimizers for group in optimizer.param_groups]
        for group, rate in zip(groups, self.rates, strict=True):
            group["lr"] = rate * rate_at(self.number, self.plan.steps)
        denoised = self.denoise(self.model, examples)
        loss = loss_of(*map(without_rim, (denoised, examples.clean, examples.noisy)))
        self.model.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), LARGEST_GRADIENT)
        for kernel, matrix in self.kernels:
            matrix.grad = _as_matrix(kernel.grad.contiguous(memory_format=torch.channels_last))
        for optimizer in self.optimizers:
            optimizer.step()
        self.mean.update_parameters(self.model)
        self.losses.append(loss.detach())
        self.number += 1

    @torch.no_grad()
    def judge(self) -> dict[str, float]:
        """Judge the running mean of the weights on examples set aside.

        Returns:
            Mean PSNR in dB of each kind of example, and the loss.
        """
        figures, losses = {}, []
        for name, examples in self.aside.items():
            images = without_rim(self.denoise(self.mean.module, examples)), without_rim(examples.clean)
            figures[name] = float(-20 * (errors(*images) / 255).log10().mean())
            losses.append(float(loss_of(*images, without_rim(examples.noisy))))
        return {"judged": statistics.mean(losses), **figures}

    def run(self, folder: Path | None = None) -> None:
        """Train up to the planned number of steps; with a folder, save a checkpoint every :data:`EVERY` steps."""
        with graphed_pivots(self.plan.device):
            self._run(folder)

    def _run(self, folder: Path | None) -> None:
        if not self.curve:
            self._check(folder)
        start, before = time.perf_counter(), self.seconds
        for examples in self.examples():
            self.step(examples.to(self.plan.device))
            self.seconds = before + time.perf_counter() - start
            if self.number % EVERY == 0 or self.number == self.plan.steps:
                self._check(folder)

    def examples(self) -> Iterable[Examples]:
        """The batches of the steps that are left, in order."""
        return DataLoader(
            self.batches,
            batch_size=None,
            sampler=range(self.number, self.plan.steps),
            num_workers=self.plan.workers,
            prefetch_factor=PREFETCHED if self.plan.workers else None,
            pin_memory=self.plan.device != "cpu",
            worker_init_fn=_with_one_thread,
            generator=torch.Generator(),  # which DataLoader draws from, needlessly; not from the global one
        )

    def _check(self, folder: Path | None) -> None:
        """Judge, print a line and save a checkpoint."""
        loss = float(torch.stack(self.losses).mean()) if self.losses else float("nan")
        figures = {"step": float(self.number), "seconds": round(self.seconds), "loss": loss, **self.judge()}
        self.curve.append({name: round(value, 4) for name, value in figures.items()})
        self.losses.clear()
        print(", ".join(f"{name} {value:g}" for name, value in self.curve[-1].items()), flush=True)
        if folder is not None:
            self._save(folder)

    def _save(self, folder: Path) -> None:
        """Write the state, the weights, the curve and its figures, each file atomically."""
        with open_beside(folder / "state.pt") as stream:
            torch.save(self.state(), stream)
        latest = self.curve[-1]
        weights = {name: value.cpu().contiguous() for name, value in self.mean.module.state_dict().items()}
        planned = {name: str(getattr(self.plan, name)) for name in ("steps", "batch", "parts", "side", "rate", "seed")}
        content = as_bytes(weights, {**planned, **{name: f"{x:g}" for name, x in latest.items()}})
        best = min(row["judged"] for row in self.curve)
        for name in ("latest", *(["denoiser"] if latest["judged"] == best else [])):
            with open_beside(folder / f"{name}.safetensors") as stream:
                stream.write(content)
        text = StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [latest, *([f"{x:g}" for x in row.values()] for row in self.curve)]
        )
        with open_beside(folder / "curve.csv") as stream:
            stream.write(text.getvalue().encode())
        save_figure(plotted(self.curve), folder / "curve.png")

    def state(self) -> dict[str, Any]:
        """Everything that :meth:`load` needs."""
        return {
            "model": self.model.state_dict(),
            "mean": self.mean.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "number": self.number,
            "curve": self.curve,
            "seconds": self.seconds,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Resume a training from its saved state."""
        self.model.load_state_dict(state["model"])
        self.mean.load_state_dict(state["mean"])
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)
        self.number, self.curve, self.seconds = state["number"], state["curve"], state["seconds"]


def without_rim(crops: Tensor) -> Tensor:
    """The pixels of crops (B, C, H, W) whose errors count."""
    rim = min(RIM, crops.shape[-1] // 4)
    return crops[..., rim:-rim, rim:-rim]


def plotted(curve: list[dict[str, float]]) -> Figure:
    """Plot the PSNR of each kind of example set aside, relative to the first, against the steps."""
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.add_subplot()
    steps = [row["step"] / 1000 for row in curve]
    for name in curve[0]:
        if "," in name and not name.startswith("clean"):
            axes.plot(steps, [row[name] - curve[0][name] for row in curve], label=name)
    axes.set(xlabel="thousand steps", ylabel="gain in dB", title="Crops set aside")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def _with_one_thread(worker: int) -> None:
    torch.set_num_threads(1)


def _as_matrix(kernel: Tensor) -> Tensor:
    """View a channels-last kernel as a matrix with one row per output."""
    return kernel.detach().permute(0, 2, 3, 1).view(len(kernel), -1)
