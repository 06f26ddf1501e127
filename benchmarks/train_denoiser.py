"""Train the denoiser: ``python -m benchmarks.train_denoiser [--out FOLDER] [--steps N] [--seed N] [--plain]``.

Trains :class:`nlfilter_torch.NonlocalDenoiser` on crops of scikit-image's pictures (:mod:`benchmarks.denoiser_crops`),
half of them grey, half in colour, with noise of 0 to 60 grey levels. The loss is the mean, over crops, of the root mean
squared error; the saved weights are running means of the trained ones. The folder contains

denoiser.safetensors   the weights, with the results of the training as metadata;
denoiser.json          arguments, times and losses;
curve.png              the loss on validation crops;
state.pt               the state of the training: the same command resumes a stopped training, and a larger number of
                       steps continues a finished one.

``--start FILE`` starts from trained weights and raises the learning rate again. ``--passes 1`` trains a single pass of
the network, in half the time; the second pass of its weights repeats the first. ``--plain`` trains the same network
with a further convolution in place of the filter, for comparison. Equal arguments give equal weights on the same
machine with the same number of threads.
"""

import argparse
import json
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from safetensors import safe_open
from safetensors.torch import save as as_bytes
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from benchmarks.denoiser_crops import CONTRASTS, MISSTATED, Crops
from nlfilter_torch.nn.denoiser.network import (
    PASSES,
    PLANES,
    SLOPE,
    WIDTH,
    Layer,
    NonlocalDenoiser,
    level_planes,
    shapes_of,
)
from nlfilter_torch.nn.denoiser.weights import read_weights
from nlfilter_torch.photo.io.writing import open_beside
from nlfilter_torch.photo.plotting import save_figure

BATCH = 6  # crops in a step
SIDE = 64  # pixels of a crop
RATE = 4e-3  # of Muon, for the kernels of the convolutions
ADAM_RATE = 0.5  # of Adam, for all other weights, relative to that of Muon
BANDWIDTH_RATE = 2.5  # of Adam, for bandwidths, which are scalars learned as logarithms, likewise
EXPECTED = 0.55  # exponent with which the error of a denoiser grows with the noise
WARM_UP = 200  # steps over which the learning rate rises
FALL = 0.4  # final share of the steps, over which the learning rate falls to zero along half a cosine
LARGEST_GRADIENT = 0.5  # norm to which gradients are clipped
MEAN_OVER = 500  # time constant of the running mean of the weights, in steps
EVERY = 500  # steps between printed lines, points of the curve and saved states
ASIDE, ASIDE_SEED = 24, 1_000_000  # validation crops of each kind, and their seed


class PlainDenoiser(NonlocalDenoiser):
    """The denoiser without the filter: a convolution, with more weights, in place of guide and sliders."""

    def __init__(self, passes: int = PASSES) -> None:
        super().__init__(passes)
        del self.log_bandwidths
        self.guide = Layer(WIDTH, WIDTH)
        self.picture = nn.Conv2d(WIDTH, PLANES, 1)
        self.register_buffer("log_bandwidths", torch.zeros(2), persistent=False)

    def smooth(self, features: Tensor, planes: Tensor, pixels: int) -> Tensor:
        """Estimate the smoothed planes by convolutions."""
        change: Tensor = self.picture(F.leaky_relu(self.guide(features), SLOPE))
        return planes + change.to(planes)


def errors(image: Tensor, clean: Tensor) -> Tensor:
    """Root mean squared error of each crop, in grey levels."""
    return 255 * ((image - clean).square().mean((1, 2, 3)) + 1e-8).sqrt()


def loss_of(denoised: Tensor, clean: Tensor, noisy: Tensor) -> Tensor:
    """Mean error of crops relative to the error expected for their noise, so that weak noise counts equally."""
    return (errors(denoised, clean) / (1 + errors(noisy, clean)) ** EXPECTED).mean()


def rate_at(step: int, steps: int, fall: float = FALL) -> float:
    """Learning rate at a step, relative to the full rate."""
    if step < WARM_UP:
        return (step + 1) / WARM_UP
    passed = max(0.0, (step / steps - (1 - fall)) / fall)
    return 0.5 + 0.5 * float(torch.cos(torch.tensor(torch.pi * min(1.0, passed))))


def _as_matrix(kernel: Tensor) -> Tensor:
    """View a channels-last kernel as a matrix with one row per output."""
    return kernel.detach().permute(0, 2, 3, 1).view(len(kernel), -1)


def new_denoiser(*, plain: bool, seed: int, passes: int) -> NonlocalDenoiser:
    """Create a denoiser with weights drawn from a seed."""
    with torch.random.fork_rng(devices=[]):  # layers draw their weights from the global generator
        torch.manual_seed(seed)
        return PlainDenoiser(passes) if plain else NonlocalDenoiser(passes)


class Training:
    """A training that can be stopped and resumed.

    Args:
        seed: of weights, crops and noise.
        plain: whether to train the network without the filter.
        side: of crops, in pixels.
        half: whether convolutions run in bfloat16.
        rate: of Muon, for kernels of convolutions; those of Adam are in proportion.
        start: file of the initial weights; None draws them.
        fall: final share of the steps, over which the learning rate falls to zero.
        textured: share of crops with an added texture.
        contrast: largest standard deviation of such a texture.
        misstated: share of crops whose given noise level is not the actual one.
        rim: width of the outermost pixels of crops, in which errors do not count.
        passes: of the network.
    """

    def __init__(
        self,
        seed: int,
        *,
        plain: bool = False,
        side: int = SIDE,
        half: bool = False,
        rate: float = RATE,
        start: Path | None = None,
        fall: float = FALL,
        textured: float = 0.0,
        contrast: float = CONTRASTS[1],
        misstated: float = MISSTATED,
        rim: int = 0,
        passes: int = PASSES,
    ) -> None:
        self.model = new_denoiser(plain=plain, seed=seed, passes=passes).to(memory_format=torch.channels_last)
        if start is not None:
            self.model.load_state_dict(read_weights(start, shapes_of(self.model)))
        self.mean = AveragedModel(self.model, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / MEAN_OVER))
        named = {name: weight for name, weight in self.model.named_parameters() if weight.requires_grad}
        bandwidths = [named.pop("log_bandwidths")] if "log_bandwidths" in named else []
        self.kernels = [
            (weight, _as_matrix(weight)) for weight in named.values() if weight.ndim == 4 and len(weight) > PLANES
        ]
        others = [weight for weight in named.values() if weight.ndim == 1 or len(weight) <= PLANES]
        self.optimizers = [
            torch.optim.Muon(
                [matrix for _, matrix in self.kernels],
                lr=rate,
                weight_decay=0.0,
                adjust_lr_fn="match_rms_adamw",
            ),
            torch.optim.Adam([{"params": others}, {"params": bandwidths}], lr=rate),
        ]
        self.rates = (rate, ADAM_RATE * rate, BANDWIDTH_RATE * rate)
        self.half, self.fall, self.rim = half, fall, rim
        kinds = {"textured": textured, "contrast": contrast, "misstated": misstated}
        self.crops = Crops(side, seed, **kinds)
        aside = Crops(side, ASIDE_SEED, **kinds)
        self.aside = [aside.batch(ASIDE, grey=grey) for grey in (True, False)]
        self.losses: list[float] = []
        self.curve: list[float] = []
        self.seconds = 0.0

    def denoise(self, model: nn.Module, noisy: Tensor, told: Tensor) -> Tensor:
        """Denoise crops as in training."""
        with torch.autocast("cpu", torch.bfloat16, enabled=self.half):
            noise: Tensor = model.estimate_noise(noisy, level_planes(told, noisy))  # type: ignore[operator]
        return noisy - noise

    def without_rim(self, crops: Tensor) -> Tensor:
        """The pixels of crops (B, C, H, W) whose errors count."""
        counted = slice(self.rim, crops.shape[-1] - self.rim)
        return crops[..., counted, counted]

    def step(self, steps: int) -> None:
        """Train one step, out of ``steps`` in all."""
        number = len(self.losses)
        groups = [group for optimizer in self.optimizers for group in optimizer.param_groups]
        for group, rate in zip(groups, self.rates, strict=True):
            group["lr"] = rate * rate_at(number, steps, self.fall)
        clean, noisy, told = self.crops.batch(BATCH, grey=number % 2 == 0)
        loss = loss_of(*map(self.without_rim, (self.denoise(self.model, noisy, told), clean, noisy)))
        self.model.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), LARGEST_GRADIENT)
        for kernel, matrix in self.kernels:
            matrix.grad = _as_matrix(kernel.grad.contiguous(memory_format=torch.channels_last))
        for optimizer in self.optimizers:
            optimizer.step()
        self.mean.update_parameters(self.model)
        self.losses.append(loss.item())

    @torch.no_grad()
    def judge(self) -> float:
        """Mean error of the running-mean weights on the validation crops, in grey levels."""
        losses = [
            errors(*map(self.without_rim, (self.denoise(self.mean.module, noisy, told), clean)))
            for clean, noisy, told in self.aside
        ]
        return float(torch.stack(losses).mean())

    def run(self, steps: int, folder: Path | None = None) -> None:
        """Train up to ``steps`` steps in all; with a folder, save the state every :data:`EVERY` steps."""
        start, before = time.perf_counter(), self.seconds
        while len(self.losses) < steps:
            self.step(steps)
            if len(self.losses) % EVERY and len(self.losses) < steps:
                continue
            self.seconds = before + time.perf_counter() - start
            self.curve.append(self.judge())
            recent = statistics.mean(self.losses[-EVERY:])
            print(
                f"step {len(self.losses):6} of {steps}: loss {recent:.4f}, set aside {self.curve[-1]:.3f} grey levels, "
                f"{self.seconds:.0f} s",
                flush=True,
            )
            if folder is not None:
                with open_beside(folder / "state.pt") as stream:
                    torch.save(self.state(), stream)

    def state(self) -> dict[str, Any]:
        """Everything that :meth:`load` needs."""
        return {
            "model": self.model.state_dict(),
            "mean": self.mean.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "generator": self.crops.generator.get_state(),
            "losses": self.losses,
            "curve": self.curve,
            "seconds": self.seconds,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Resume a training from its saved state."""
        self.model.load_state_dict(state["model"])
        self.mean.load_state_dict(state["mean"])
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)
        self.crops.generator.set_state(state["generator"])
        self.losses, self.curve, self.seconds = state["losses"], state["curve"], state["seconds"]


def save(folder: Path, training: Training, figures: dict[str, Any]) -> None:
    """Write weights, results and the curve, each file atomically."""
    weights = {name: value.contiguous() for name, value in training.mean.module.state_dict().items()}
    with open_beside(folder / "denoiser.safetensors") as stream:
        stream.write(as_bytes(weights, {name: str(value) for name, value in figures.items()}))
    with open_beside(folder / "denoiser.json") as stream:
        stream.write(json.dumps({**figures, "set_aside": training.curve}, indent=2).encode())
    save_figure(curve(training.curve), folder / "curve.png")


def curve(losses: Sequence[float]) -> Figure:
    """Plot the error on validation crops against the steps."""
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([EVERY * (i + 1) / 1000 for i in range(len(losses))], losses)
    axes.set(xlabel="thousand steps", ylabel="RMSE, grey levels", title="Loss on crops set aside")
    axes.grid(alpha=0.3)
    return figure


def read_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read and check the arguments."""
    parser = argparse.ArgumentParser(description="Train the denoiser.")
    parser.add_argument("--steps", type=int, default=26000, help=f"of {BATCH} crops each; default %(default)s")
    parser.add_argument("--side", type=int, default=SIDE, help="of crops, in pixels; default %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of weights, crops and noise; default %(default)s")
    parser.add_argument("--rate", type=float, default=RATE, help="of Muon, for convolutions; default %(default)s")
    parser.add_argument(
        "--fall", type=float, default=FALL, help="final share of the steps, with a falling rate; default %(default)s"
    )
    parser.add_argument("--start", type=Path, metavar="FILE", help="initial weights; default: drawn at random")
    parser.add_argument(
        "--textured", type=float, default=0.0, help="share of crops with an added texture; default %(default)s"
    )
    parser.add_argument(
        "--contrast",
        type=float,
        default=round(255 * CONTRASTS[1]),
        help="largest standard deviation of such a texture, in grey levels; default %(default)s",
    )
    parser.add_argument(
        "--misstated",
        type=float,
        default=MISSTATED,
        help="share of crops whose given noise level is not the actual one; default %(default)s",
    )
    parser.add_argument(
        "--rim",
        type=int,
        default=0,
        help="width of the outermost pixels of crops, in which errors do not count; default %(default)s",
    )
    parser.add_argument("--passes", type=int, default=PASSES, help="of the network; default %(default)s")
    parser.add_argument("--plain", action="store_true", help="a convolution in place of the filter")
    parser.add_argument(
        "--half", action="store_true", help="convolutions in bfloat16, fast where the processor has AMX"
    )
    parser.add_argument("--out", type=Path, default=Path("out/denoiser"), help="folder; default %(default)s")
    options = parser.parse_args(arguments)
    check_steps(parser, options)
    check_crops(parser, options)
    if options.start is not None and not options.start.is_file():
        parser.error(f"--start must be a file of weights, got {options.start}, which is not there; train one first")
    if options.out.exists() and not options.out.is_dir():
        parser.error(f"--out must be a folder, got the file {options.out}; name another")
    return options


def check_steps(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End with an error if the steps of the training cannot be taken."""
    if options.steps < 1:
        parser.error(f"--steps must be at least 1, got {options.steps}; 2000 give a first impression")
    if not 16 <= options.side <= 128:
        parser.error(f"--side must be 16 to 128, got {options.side}; {SIDE} does well")
    if options.seed < 0:
        parser.error(f"--seed must not be negative, got {options.seed}; 0 will do")
    if not 0 < options.rate < 1:
        parser.error(f"--rate must be between 0 and 1, got {options.rate}; {RATE} does well")
    if not 0 < options.fall <= 1:
        parser.error(f"--fall must be above 0 and at most 1, got {options.fall}; {FALL} does well")


def check_crops(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End with an error if crops cannot be made, or not used."""
    for name in ("textured", "misstated"):
        if not 0 <= getattr(options, name) <= 1:
            parser.error(f"--{name} must be 0 to 1, got {getattr(options, name)}; it is a share of the crops")
    if not 255 * CONTRASTS[0] <= options.contrast <= 255:
        parser.error(f"--contrast must be {255 * CONTRASTS[0]:.0f} to 255, got {options.contrast}; 40 does well")
    if not 0 <= options.rim < options.side / 2:
        parser.error(f"--rim must be at least 0 and less than half of --side, got {options.rim}; 8 does well")
    if options.passes < 1:
        parser.error(f"--passes must be at least 1, got {options.passes}; {PASSES} are what the package has")


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and save the results."""
    options = read_options(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    training = Training(
        options.seed,
        plain=options.plain,
        side=options.side,
        half=options.half,
        rate=options.rate,
        start=options.start,
        fall=options.fall,
        textured=options.textured,
        contrast=options.contrast / 255,
        misstated=options.misstated,
        rim=options.rim,
        passes=options.passes,
    )
    state = options.out / "state.pt"
    if state.exists():
        training.load(torch.load(state, weights_only=True))
        print(f"taken up at step {len(training.losses)}")
    parameters = sum(parameter.numel() for parameter in training.model.parameters())
    print(f"{parameters} weights, crops of {options.side} pixels, {torch.get_num_threads()} threads", flush=True)
    figures = {
        name: getattr(options, name)
        for name in (
            *("steps", "side", "seed", "rate", "fall"),
            *("textured", "contrast", "misstated", "rim", "passes", "plain", "half"),
        )
    }
    if options.start is not None:
        with safe_open(options.start, "pt") as weights:
            figures["start"] = weights.metadata()
    training.run(options.steps, options.out)
    figures |= {"weights": parameters, "seconds": round(training.seconds), "loss": round(training.curve[-1], 4)}
    save(options.out, training, figures)
    print(f"{options.out / 'denoiser.safetensors'}: {figures['loss']} grey levels on crops set aside")


if __name__ == "__main__":
    main()
