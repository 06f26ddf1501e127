"""What denoising gains on photographs with the noise of cameras: ``python -m benchmarks.real_noise FOLDER``.

The folder holds pairs of one shot and the mean of many, ``NAME_real.*`` and ``NAME_mean.*`` (or ``_noisy`` and
``_clean``). The table shows, for each pair, PSNR of the shot, of ``denoise(grain=0)`` without being told anything,
told the true profile and the true deviation, the gain over the shot, and the level and coarseness that were estimated.
Then follow the means, the worst pair, and estimates over the truth by scale. ``--set`` selects the pairs that
``benchmarks/camera_noise.txt`` lists for choosing or for reporting; ``--peers`` adds CBM3D and the non-local means of
scikit-image and OpenCV, all told the true deviation, the latter with the best of four strengths for each picture.

``--clean FOLDER`` measures instead how little ``denoise`` changes photographs without noise, and ``--cameras FOLDER``
the estimates on pictures of a folder as taken by simulated cameras that training never draws.
"""

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.denoising.cases import Case, psnr
from benchmarks.denoising.methods import available
from benchmarks.harness import options, read_picture, row
from benchmarks.photographs import pictures
from nlfilter_torch.nn.denoiser.estimate import noise_profile
from nlfilter_torch.nn.denoiser.profile import NoiseProfile, profile_of_difference, split_colours
from nlfilter_torch.photo import denoise

LISTED = Path(__file__).with_name("camera_noise.txt")
ENDINGS = {"_real": "_mean", "_noisy": "_clean"}
PEERS = ("BM3D", "scikit-image NLM", "OpenCV NLM")
MEDIAN = 0.6745  # median of the absolute value of a standard normal variable
QUICK = (..., slice(0, 96), slice(0, 96))
CAMERA_SIDE, CAMERAS = 320, 60
UNREDUCED = 10**6  # pixels of the short side


@dataclass(frozen=True)
class Row:
    """Figures of one pair: PSNR by method, and estimated over true levels (S, 2)."""

    name: str
    psnr: dict[str, float]
    level: float
    coarseness: float
    ratios: Tensor

    @property
    def gain(self) -> float:
        """Of ours over the shot, in dB."""
        return self.psnr["ours"] - self.psnr["noisy"]


def listed(part: str) -> list[str]:
    """Names of the pairs for ``"choosing"`` or ``"reporting"``."""
    names: dict[str, list[str]] = {}
    for line in LISTED.read_text().splitlines():
        if line.startswith("["):
            names[line.strip("[]")] = []
        elif not line.startswith("#"):
            names[list(names)[-1]].append(line)
    return names[part]


def pairs_of(folder: Path, names: Sequence[str] | None) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Pairs (1, 3, H, W) by name: the shot and the mean of many."""
    for path in sorted(folder.iterdir()):
        for ending, clean in ENDINGS.items():
            name = path.stem.removesuffix(ending)
            if path.stem.endswith(ending) and (names is None or name in names):
                yield (
                    name,
                    *(read_picture(file)[None] for file in (path, path.with_name(f"{name}{clean}{path.suffix}"))),
                )


def true_levels(noisy: Tensor, clean: Tensor) -> Tensor:
    """Levels (S, 2) of the noise over the whole picture, by medians, which rare misalignments do not affect."""
    planes = split_colours(_noise(noisy, clean))
    rows = []
    for scale in NoiseProfile.SCALES:
        means = F.avg_pool2d(planes, scale).abs() * scale / MEDIAN
        rows.append(torch.stack([means[:, :1].median(), means[:, 1:].median()]))
    return torch.stack(rows)


def measured_levels(profile: NoiseProfile, noisy: Tensor) -> Tensor:
    """Median levels (S, 2) of a profile at the pixels of a picture."""
    return profile.at(noisy)[0].flatten(1).median(1).values.view(-1, 2)


def row_of(name: str, noisy: Tensor, clean: Tensor, peers: Sequence[str]) -> Row:
    """Measure one pair."""
    noise, profile = _noise(noisy, clean), noise_profile(noisy)
    truth = profile_of_difference(clean + noise, clean)
    deviation = float(noise.std())
    results = {
        "noisy": noisy,
        "ours": denoise(noisy, grain=0),
        "told the profile": denoise(noisy, noise_level=truth),
        "told the deviation": denoise(noisy, noise_level=deviation),
    }
    case = Case(name, clean, noisy, deviation)
    results |= {peer: method(case) for peer, method in available(peers).items()}
    ratios = measured_levels(profile, noisy) / true_levels(noisy, clean).clamp(min=1e-6)
    figures = {method: psnr(result.clamp(0, 1), clean) for method, result in results.items()}
    return Row(name, figures, 255 * float(profile.level), float(profile.coarseness), ratios)


def _noise(noisy: Tensor, clean: Tensor) -> Tensor:
    """The difference without its mean: the light of shots differs a little."""
    difference = noisy - clean
    return difference - difference.mean((2, 3), keepdim=True)


def show(rows: Sequence[Row]) -> None:
    """Print the table, means, the worst pair, and estimates over the truth."""
    methods = list(rows[0].psnr)
    print(row("pair", methods, 19, 38) + row("", ("gain", "level", "coarse"), 8, 0))
    for each in rows:
        rest = row("", (f"{value:.2f}" for value in (each.gain, each.level, each.coarseness)), 8, 0)
        print(row(each.name, (f"{each.psnr[name]:.2f}" for name in methods), 19, 38) + rest)
    print(row("mean", (f"{statistics.mean(each.psnr[name] for each in rows):.2f}" for name in methods), 19, 38))
    worst, weak = min(rows, key=lambda each: each.gain), [each for each in rows if each.psnr["noisy"] < 37]
    print(f"mean gain {statistics.mean(each.gain for each in rows):.2f} dB; worst {worst.gain:.2f} dB, {worst.name}")
    print(f"of {len(weak)} pairs below 37 dB, {sum(each.gain >= 1 for each in weak)} gain at least 1 dB")
    show_ratios(torch.stack([each.ratios for each in rows]))


def show_ratios(ratios: Tensor) -> None:
    """Print medians of estimated over true levels (N, S, 2), and of their errors."""
    for plane, name in enumerate(("luminance", "colour")):
        middle, errors = (values[..., plane].median(0).values for values in (ratios, (ratios - 1).abs()))
        texts = [f"{scale}: {m:.2f} ({e:.0%})" for scale, m, e in zip(NoiseProfile.SCALES, middle, errors, strict=True)]
        print(f"estimated over true level of {name}, by scale, median (median error): " + ", ".join(texts))


def clean_photographs(folder: Path, *, quick: bool) -> None:
    """Print the estimates on clean photographs, and how little they change."""
    levels, kept = [], []
    for name, picture in pictures(folder, UNREDUCED, ()).items():
        clean = picture[QUICK] if quick else picture
        levels.append(255 * float(noise_profile(clean).level))
        kept.append(psnr(denoise(clean, grain=0), clean))
        print(f"{name:38} {levels[-1]:6.2f} levels {kept[-1]:7.1f} dB to itself", flush=True)
    print(f"median {statistics.median(levels):.2f} levels, {statistics.median(kept):.1f} dB; least {min(kept):.1f} dB")


def simulated(folder: Path, *, count: int) -> None:
    """Print errors of the estimates on simulated cameras that training never draws."""
    from benchmarks.training.noise_profiles import Pairs
    from benchmarks.training.pictures import Draws

    pairs, random, ratios = Pairs(folder, held_out=True), Draws(77), []
    while len(ratios) < count:
        pair = pairs.camera(random, CAMERA_SIDE)
        if pair is not None:
            noisy, truth = pair.noisy[None], true_levels(pair.noisy[None], pair.clean[None])
            if 255 * float((truth[0, 0].square() + 2 / 3 * truth[0, 1].square()).sqrt()) > 1:
                ratios.append(measured_levels(noise_profile(noisy), noisy) / truth.clamp(min=1e-6))
    print(f"{count} simulated cameras with noise of more than one grey level")
    show_ratios(torch.stack(ratios))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure."""
    parser = options("real_noise", __doc__, "parts of the pictures, and few of them")
    add = parser.add_argument
    add("folder", type=Path, nargs="?", help="of pairs")
    add("--set", choices=("choosing", "reporting"), help="default: all pairs of the folder")
    add("--peers", action="store_true", help="also measure other denoisers")
    add("--clean", type=Path, help="folder of photographs without noise")
    add("--cameras", type=Path, help="folder of pictures that simulated cameras take")
    chosen = parser.parse_args(arguments)
    if chosen.folder is not None:
        rows = []
        for name, noisy, clean in pairs_of(chosen.folder, listed(chosen.set) if chosen.set else None):
            part = QUICK if chosen.quick else ...
            rows.append(row_of(name, noisy[part], clean[part], PEERS if chosen.peers else ()))
        show(rows)
    if chosen.clean is not None:
        clean_photographs(chosen.clean, quick=chosen.quick)
    if chosen.cameras is not None:
        simulated(chosen.cameras, count=3 if chosen.quick else CAMERAS)


if __name__ == "__main__":
    main()
