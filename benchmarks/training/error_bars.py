"""Training of the standard errors of denoised pixels: ``python -m benchmarks.training.error_bars --pictures FOLDER``.

Pictures get white noise of known level, or that of simulated cameras, whose profile is then estimated; photographs of
``--pairs`` have real noise (those for choosing of ``benchmarks/camera_noise.txt``). The denoiser is the network, the
filter alone, or the network in part. What :func:`~nlfilter_torch.standard_error` tells its network, and the true
errors, are kept for some pixels of each picture under ``--out``. ``--fit`` trains the network on them in a minute: on
the interval score of 1.645 standard errors to either side, which is least for intervals that hold 90 % of the pixels.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from benchmarks.harness import options
from benchmarks.real_noise import listed, pairs_of
from benchmarks.training.development import blurred
from benchmarks.training.noise_profiles import Pairs
from benchmarks.training.pictures import Draws
from nlfilter_torch import NoiseProfile, NonlocalDenoiser, noise_profile
from nlfilter_torch.nn.denoiser.error import ERROR_INPUTS, ERROR_LAYERS, KINDS, NORMAL, SHAPES, error_inputs, log_ratio
from nlfilter_torch.photo import denoise

SIDE, CAMERA_SIDE, LEVELS = 192, 256, (5, 60)
CAMERAS, ROUNDED, GREY = 0.15, 0.1, 0.2  # shares of the pictures
RULE, PARTLY = (
    0.12,
    0.2,
)  # shares of the denoisers: the filter alone up to the first, the network in part up to the second
PER_PICTURE, EVERY_APART = 4000, 8  # values kept of a picture; every so many pictures are held out
GRAINY, GRAIN = 0.6, (0.7, 5.0)  # share of the pictures with white noise that have grain, and its deviation in levels
EVERY_WHITE = 3  # every so many pictures with white noise are among those with a profile, which may be white
FAINT = 0.5 / 255  # deviation of the noise from which values count
BATCH, RATE, DECAY = 4096, 1e-2, 1e-2
# Steps, and noise of the inputs in their deviations: of those that differ within a picture, and of the others.
TRAINING = {"known": (1500, 0.05, 0.1), "profile": (700, 0.1, 0.5)}
ALPHA, LEAST = 0.1, 0.05  # share outside the intervals; least scale of the score, in deviations of the noise

Example = tuple[Callable[[Tensor], Tensor], Tensor, Tensor, float | NoiseProfile]


class Examples:
    """Denoisers with noisy and clean pictures and the noise that the denoiser is told, reproducible from a seed."""

    def __init__(self, folder: Path) -> None:
        self.pairs = Pairs(folder, held_out=False)
        self.network = NonlocalDenoiser.trained().requires_grad_(False)

    def drawn(self, seed: int) -> Example:
        """One of noise that is simulated."""
        random = Draws(seed)
        while True:
            if random.chance(CAMERAS):
                pair = self.pairs.camera(random, CAMERA_SIDE)
                if pair is None:
                    continue
                noisy, clean = pair.noisy[None], pair.clean[None]
                noise: float | NoiseProfile = noise_profile(noisy)
                if float(noise.level) > 1 / 255:
                    return self.denoiser(random, noise), noisy, clean, noise
                continue
            crop = self.pairs.crop(random, SIDE)
            if crop is not None:
                clean = crop[None].mean(1, keepdim=True) if random.chance(GREY) else crop[None]
                noise = random.factor(*LEVELS) / 255
                if random.chance(GRAINY):  # reduced pictures lack the grain of photographs, which a denoiser removes
                    grain = blurred(random.normal(*clean.shape)[0], random.number(0.3, 1.0))[None]
                    clean = clean + random.factor(*GRAIN) / 255 * grain / grain.std()
                noisy = clean + noise * random.normal(*clean.shape)
                noisy = (255 * noisy.clamp(0, 1)).round() / 255 if random.chance(ROUNDED) else noisy
                return self.denoiser(random, noise), noisy, clean, noise

    def denoiser(self, random: Draws, noise: float | NoiseProfile) -> Callable[[Tensor], Tensor]:
        """A random denoiser, told the noise."""
        kind = random.number()
        if kind < RULE and not isinstance(noise, NoiseProfile):
            return partial(denoise, noise_level=noise, method="rule")
        network = partial(self.network, noise=noise)
        share = random.number() if RULE < kind < PARTLY else 1.0
        return lambda image: torch.lerp(image, network(image), share)

    def real(self, folder: Path) -> Iterator[Example]:
        """Of pairs of real noise, two opposite quarters of each photograph."""
        for _, noisy, clean in pairs_of(folder, listed("choosing")):
            noise, clean = noise_profile(noisy), clean + (noisy - clean).mean((2, 3), keepdim=True)  # of another light
            for part in (slice(0, CAMERA_SIDE), slice(CAMERA_SIDE, None)):
                window = (..., part, part)
                yield partial(self.network, noise=noise), noisy[window], clean[window], noise


def values_of(example: Example, seed: int) -> Tensor:
    """Inputs and true error, in deviations of the noise, (PER_PICTURE, ERROR_INPUTS + 1), of values of a picture."""
    function, noisy, clean, noise = example
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        inputs = error_inputs(function, noisy, noise, random)
        error = (function(noisy) - clean).abs() / inputs.deviation
    table = torch.cat([inputs.table(slice(None)), error.unsqueeze(-1)], dim=-1).flatten(0, -2)
    return table[torch.randint(len(table), (PER_PICTURE,), generator=random)]


def fit(folder: Path, out: Path) -> None:
    """Train on the pictures in a folder, and write the weights."""
    torch.manual_seed(0)
    weights = {}
    tables = {kind: [torch.load(path) for path in sorted(folder.glob(f"{kind}*.pt"))] for kind in KINDS}
    tables["profile"] += tables["known"][::EVERY_WHITE]
    for kind in KINDS:
        fitted = fit_kind(tables[kind], kind)
        weights |= {f"{kind}.{name}": value.detach().contiguous() for name, value in fitted.items()}
    save_file({name: weights[name] for name in SHAPES}, out)


def fit_kind(tables: Sequence[Tensor], kind: str) -> dict[str, Tensor]:
    """Train for a kind of noise, and print the score and the coverage of the pictures held out."""
    counted = [rows[rows[:, ERROR_INPUTS - 1] > math.log(FAINT)] for rows in tables]
    counted = [rows for rows in counted if len(rows) > PER_PICTURE // 2]
    apart, others = counted[::EVERY_APART], [rows for n, rows in enumerate(counted) if n % EVERY_APART]
    table, (steps, blur, blur_of_overall) = torch.cat(others), TRAINING[kind]
    inputs = table[:, :ERROR_INPUTS]
    weights = {"mean": inputs.mean(0), "scale": inputs.std(0).clamp(min=0.05)}
    for name, size in ERROR_LAYERS.items():
        layer = torch.nn.Linear(size[1], size[0])
        weights |= {f"{name}.weight": layer.weight.detach(), f"{name}.bias": layer.bias.detach()}
    spread = weights["scale"] * torch.where((inputs.diff(dim=0) == 0).float().mean(0) > 0.5, blur_of_overall, blur)
    trained = [value.requires_grad_() for name, value in weights.items() if "." in name]
    optimizer = torch.optim.AdamW(trained, RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in range(steps):
        rows = table[torch.randint(len(table), (BATCH,))]
        rows = rows + torch.nn.functional.pad(spread, (0, 1)) * torch.randn_like(rows)
        loss = score(weights, rows).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        held = torch.stack([score(weights, rows).mean() for rows in apart])
        covered = torch.stack([coverage(weights, rows) for rows in apart])
    near = int(((covered - 0.9).abs() <= 0.02).sum())
    print(
        f"{kind}, {len(others)} pictures: score {float(loss.detach()):.4f}, held out {float(held.mean()):.4f}", end=", "
    )
    print(f"covered {float(covered.mean()):.3f} +- {float(covered.std()):.3f}, {near} of {len(covered)} within 0.02")
    return weights


def coverage(weights: dict[str, Tensor], table: Tensor) -> Tensor:
    """Share of values (n, ERROR_INPUTS + 1) within 1.645 standard errors."""
    return (table[:, ERROR_INPUTS] <= NORMAL * log_ratio(weights, table[:, :ERROR_INPUTS]).exp()).float().mean()


def score(weights: dict[str, Tensor], table: Tensor) -> Tensor:
    """Interval score of values (..., ERROR_INPUTS + 1), relative to the errors that are expected."""
    width, error = NORMAL * log_ratio(weights, table[..., :ERROR_INPUTS]).exp(), table[..., ERROR_INPUTS]
    expected = table[..., 2].exp().sqrt() + LEAST  # from the average over 3 pixels
    return (2 * width + 2 / ALPHA * (error - width).clamp(min=0)) / expected


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the values, or train on them."""
    parser = options("training.error_bars", __doc__)
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of pictures; with it, values are made")
    add("--pairs", type=Path, help="folder of pairs with real noise")
    add("--out", type=Path, default=Path("errors"), help="folder of the values")
    add("--first", type=int, default=0, help="number of the first picture")
    add("--count", type=int, default=200, help="number of pictures with simulated noise")
    add("--fit", type=Path, help="train, and write the weights to this file")
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)
    if chosen.pictures is not None:
        examples = Examples(chosen.pictures)
        for number in range(chosen.first, chosen.first + chosen.count):
            if not list(chosen.out.glob(f"*-simulated-{number}.pt")):
                example = examples.drawn(number)
                kind = KINDS[isinstance(example[3], NoiseProfile)]
                torch.save(values_of(example, number), chosen.out / f"{kind}-simulated-{number}.pt")
        for number, example in enumerate(examples.real(chosen.pairs) if chosen.pairs is not None else ()):
            torch.save(values_of(example, number), chosen.out / f"profile-real-{number}.pt")
    if chosen.fit is not None:
        fit(chosen.out, chosen.fit)


if __name__ == "__main__":
    main()
