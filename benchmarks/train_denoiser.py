"""Train a denoiser around the filter and judge it: ``python -m benchmarks.train_denoiser [--out FOLDER]``.

A starting point for your own training. From the noisy image a small convolutional network computes two outputs per
pixel: a feature vector, the guide, so that W links pixels with similar features, and the sliders. It computes no pixel
values: the output is a convex combination of ``y, W y, ..., W^k y`` at every pixel, with weights that are
positive and sum to one. The filter does the denoising, and everything learns end to end: network, bandwidths, sliders.

It trains on crops of photographs that come with scikit-image, with fresh white noise of 25 grey levels. It is judged on
three that it has not seen, in grey and whole, beside

untrained      the same model as it starts;
by hand        ``nlfilter_torch.denoise``: patches as guide, sliders by rule, nothing learned;
scikit-image   ``denoise_nl_means``, fast mode, 5x5 patches within 6 pixels, h = 0.8 sigma;
OpenCV         ``fastNlMeansDenoising``, 7x7 patches in windows of 21x21, on 8 bits; of h = 15, 20, 25 and 30 the one
               that is best on these photographs.

Equal arguments train equal weights on one machine with one number of threads.
"""

import argparse
import copy
import json
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor, nn

from benchmarks.denoising import (
    NOISE,
    Method,
    Scene,
    best_opencv_strength,
    decibels,
    held_out_scenes,
    judge,
    opencv_nlm,
    part,
    skimage_nlm,
)
from benchmarks.photographs import photograph
from nlfilter_torch import NonlocalFilter, denoise
from nlfilter_torch.io.photographs import open_beside
from nlfilter_torch.plotting import save_figure, show_images

SCENES = ("astronaut", "motorcycle", "rocket")
TEXTURES = ("coins", "moon", "brick", "grass", "gravel", "immunohistochemistry", "retina", "hubble_deep_field")
SCENE_WEIGHT = 3  # photographs like those of the test are drawn more often
LARGE = 400  # pixels of the short side, from which a photograph trains at half size too
BATCH = 4  # crops in a step
RATE = 3e-3  # of Adam; it rises over the first steps and falls along half a cosine
BANDWIDTH_RATE = 5.0  # times that for bandwidths, which are single numbers and learn as logarithms
WARM_UP = 20  # steps
LARGEST_GRADIENT = 0.05  # its norm; one odd crop shall not undo a hundred steps
EVERY = 100  # steps between two lines of progress

DILATIONS = (1, 2, 3, 4, 3, 2)  # of the middle convolutions; with the first and the last they see 35x35 pixels
WIDTH = 32
FEATURES = 20
ORDER = 3
TILES = 8  # filtered at once

SIDES = (16, 96)  # of crops; quick tiles have to fit into 96x96 pixels
QUICK_SIDE = 96
SHOWN = ("noisy", "trained", "scikit-image NLM")  # in the picture, beside the clean photographs


class Denoiser(nn.Module):
    """Noisy to denoised, (B, 1, H, W) both: a network for guide and sliders, and the filter.

    Args:
        num_landmarks: M.
        seed: of the network's first weights.
    """

    def __init__(self, num_landmarks: int, seed: int) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):  # layers draw their weights from the global generator
            torch.manual_seed(seed)
            self.first = _convolution(1, WIDTH)
            self.middle = nn.ModuleList(_convolution(WIDTH, WIDTH, dilation) for dilation in DILATIONS)
            self.last = _convolution(WIDTH, FEATURES + ORDER + 1)
        self.filter = NonlocalFilter(
            learn=("photometric_bandwidth", "spatial_bandwidth"),  # the sliders come with every call
            patch_size=1,  # the network has looked around already
            photometric_bandwidth=0.15,
            spatial_bandwidth=12.0,
            num_landmarks=num_landmarks,
            guide_channels="all",
        )

    def forward(self, noisy: Tensor) -> Tensor:
        """Filter a batch of crops or tiles."""
        planes = self.first(2 * noisy - 1)
        for layer in self.middle:
            planes = planes + F.relu(layer(planes))
        guide, logits = self.last(planes).split([FEATURES, ORDER + 1], dim=1)
        # Running sums of the shares: the sliders rise to 1 for the smooth layer, so that a pixel becomes a mean.
        alpha = logits.softmax(1).cumsum(1)  # (B, k+1, H, W)
        denoised: Tensor = self.filter(noisy, guide=guide, alpha=alpha)
        return denoised


def _convolution(inputs: int, outputs: int, dilation: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=dilation, dilation=dilation, padding_mode="reflect")


def training_pictures() -> list[Tensor]:
    """The photographs (1, C, H, W) to train on, large ones at half size too."""
    pictures = [photograph(name) for name in SCENES * SCENE_WEIGHT + TEXTURES]
    large = [picture for picture in pictures if min(picture.shape[-2:]) >= LARGE]
    return pictures + [F.interpolate(picture, scale_factor=0.5, mode="area") for picture in large]


def random_crops(pictures: Sequence[Tensor], side: int, generator: torch.Generator) -> Tensor:
    """Crops (BATCH, 1, side, side), turned and mirrored, their colours mixed to grey at random."""

    def below(count: int) -> int:
        return int(torch.randint(count, (), generator=generator))

    crops = []
    for _ in range(BATCH):
        picture = pictures[below(len(pictures))]
        top, left = (below(length - side + 1) for length in picture.shape[-2:])
        mixture = torch.rand(picture.shape[1], generator=generator) + 0.1
        crop = torch.einsum("bchw,c->bhw", picture[..., top : top + side, left : left + side], mixture / mixture.sum())
        crop = torch.rot90(crop, below(4), (1, 2))
        crops.append(crop.flip(2) if below(2) else crop)
    return torch.stack(crops)


def train(model: Denoiser, steps: int, side: int, generator: torch.Generator) -> list[float]:
    """Train in place, with a line of progress now and then; the mean squared error of every step."""
    pictures = training_pictures()
    bandwidths = list(model.filter.parameters())
    network = [parameter for name, parameter in model.named_parameters() if not name.startswith("filter.")]
    optimizer = torch.optim.Adam([{"params": network, "lr": RATE}, {"params": bandwidths, "lr": BANDWIDTH_RATE * RATE}])
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: min(1.0, (step + 1) / WARM_UP) * (1 + math.cos(math.pi * step / steps)) / 2
    )
    losses: list[float] = []
    start = time.perf_counter()
    for step in range(1, steps + 1):
        clean = random_crops(pictures, side, generator)
        noisy = clean + NOISE * torch.randn(clean.shape, generator=generator)
        loss = F.mse_loss(model(noisy), clean)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), LARGEST_GRADIENT)
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        if step % EVERY == 0 or step == steps:
            recent = statistics.mean(losses[-EVERY:])
            passed = time.perf_counter() - start
            print(f"step {step:5} of {steps}: loss {recent:.5f}, {decibels(recent):.2f} dB, {passed:.0f} s", flush=True)
    return losses


@torch.no_grad()
def denoise_in_tiles(model: nn.Module, noisy: Tensor, side: int) -> Tensor:
    """Filter tiles of the training's size that overlap by half, and average what they say of a pixel.

    Each is filtered in four orientations, with landmarks of their own: the network knows no upright, and errors that
    differ average out. A tile's say falls to zero towards its border, so that no seam is left.

    Args:
        model: trained on crops of that size.
        noisy: (1, 1, H, W), at least as high and wide.
        side: of the tiles.
    """
    corners = [
        (top, left)
        for top in (*range(0, noisy.shape[-2] - side, side // 2), noisy.shape[-2] - side)
        for left in (*range(0, noisy.shape[-1] - side, side // 2), noisy.shape[-1] - side)
    ]
    profile = torch.hann_window(side + 2, periodic=False)[1:-1]
    say = torch.outer(profile, profile)
    total, weight = torch.zeros_like(noisy), torch.zeros_like(noisy)
    for start in range(0, len(corners), TILES):
        windows = [(..., slice(y, y + side), slice(x, x + side)) for y, x in corners[start : start + TILES]]
        tiles = torch.cat([noisy[window] for window in windows])
        for turns in range(4):
            results = model(tiles.rot90(turns, (2, 3))).rot90(-turns, (2, 3))
            for window, result in zip(windows, results, strict=True):
                total[window] += say * result
                weight[window] += say
    return total / weight


def read_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The arguments, checked before anything is trained."""
    parser = argparse.ArgumentParser(description="Train a denoiser around the filter and judge it.")
    parser.add_argument("--steps", type=int, default=3500, help=f"of {BATCH} crops each; default %(default)s")
    parser.add_argument("--side", type=int, default=64, help="of crops and tiles, pixels; default %(default)s")
    parser.add_argument("--landmarks", type=int, default=48, help="of a crop; default %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of weights, crops and noise; default %(default)s")
    parser.add_argument("--out", type=Path, help="folder for weights, figures and a picture; made if need be")
    parser.add_argument("--quick", action="store_true", help="judge on small parts, to see that it runs")
    options = parser.parse_args(arguments)
    if options.steps < 1:
        parser.error(f"--steps must be at least 1, got {options.steps}; 500 give a first impression")
    if not SIDES[0] <= options.side <= SIDES[1]:
        parser.error(f"--side must be {SIDES[0]} to {SIDES[1]}, got {options.side}; 64 does well")
    most = options.side**2
    if not 1 <= options.landmarks <= most:
        parser.error(f"--landmarks must be 1 to {most} for this --side, got {options.landmarks}; 48 do well")
    if options.seed < 0:
        parser.error(f"--seed must not be negative, got {options.seed}; 0 will do")
    if options.out is not None and options.out.exists() and not options.out.is_dir():
        parser.error(f"--out must be a folder, got the file {options.out}; name another")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, judge, and save where asked to."""
    options = read_options(arguments)
    model = Denoiser(options.landmarks, options.seed)
    parameters, threads = sum(parameter.numel() for parameter in model.parameters()), torch.get_num_threads()
    print(
        f"{parameters} parameters, {options.landmarks} landmarks in crops of {options.side} pixels, {threads} threads"
    )
    untrained = copy.deepcopy(model)
    clocks = time.perf_counter(), time.process_time()
    losses = train(model, options.steps, options.side, torch.Generator().manual_seed(options.seed))
    seconds, cpu_seconds = time.perf_counter() - clocks[0], time.process_time() - clocks[1]
    print(f"\n{model.filter}\n")

    scenes = held_out_scenes(QUICK_SIDE if options.quick else None)
    strength = best_opencv_strength(scenes)
    methods: dict[str, Method] = {
        "noisy": lambda noisy: noisy,
        "untrained": lambda noisy: denoise_in_tiles(untrained, noisy, options.side),
        "trained": lambda noisy: denoise_in_tiles(model, noisy, options.side),
        "by hand": lambda noisy: denoise(noisy, noise_level=NOISE),
        "scikit-image NLM": skimage_nlm,
        f"OpenCV NLM, h = {strength}": lambda noisy: opencv_nlm(noisy, strength),
    }
    table, results = judge(methods, scenes)
    ahead = table["trained"]["mean"] - table["scikit-image NLM"]["mean"]
    print(
        f"\ntrained in {seconds:.0f} s ({cpu_seconds:.0f} s of processor time); {ahead:+.2f} dB to scikit-image's NLM"
    )
    if options.out is not None:
        figures = {
            "arguments": {name: getattr(options, name) for name in ("steps", "side", "landmarks", "seed", "quick")},
            "threads": threads,
            "seconds": seconds,
            "cpu_seconds": cpu_seconds,
            "loss": [statistics.mean(losses[i : i + EVERY]) for i in range(0, len(losses), EVERY)],
            "psnr": table,
        }
        save(options.out, model, figures, picture(scenes, results, whole=options.quick))


def picture(scenes: Sequence[Scene], results: Mapping[str, Mapping[str, Tensor]], *, whole: bool) -> Figure:
    """A row for every photograph, whole or a part of it: noisy, trained, another method, clean."""
    panels: dict[str, Tensor] = {}
    for scene in scenes:
        row = {method: results[method][scene.name] for method in SHOWN} | {"clean": scene.clean}
        for label, image in row.items():
            panels[f"{scene.name}, {label}"] = image if whole else part(scene.name, image)
    return show_images(panels, columns=len(SHOWN) + 1, side=320)


def save(folder: Path, model: Denoiser, figures: Mapping[str, object], figure: Figure) -> None:
    """Write weights, figures and picture; each file appears complete or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    with open_beside(folder / "denoiser.pt") as stream:
        torch.save(model.state_dict(), stream)
    with open_beside(folder / "denoiser.json") as stream:
        stream.write(json.dumps(figures, indent=2).encode())
    save_figure(figure, folder / "denoiser.png")


if __name__ == "__main__":
    main()
