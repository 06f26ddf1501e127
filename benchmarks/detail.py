"""What detail costs in halos, noise and clipping, beside other methods of equal gain: ``python -m benchmarks.detail``.

The detail preset (sliders g, g, g, 1 and the defaults of ``enhance``) and other methods boost the detail of the
luminance of the same photographs. Their strength is set by bisection so that the fine part, which a Gaussian of 2
pixels removes, is 1.5 and 2 times as strong (RMS) on mid-strength texture: pixels whose local activity is between the
50 and 85 % quantiles of the picture. Everything is measured after rounding to 8 bits:

halo      99th percentile of the excess over the local range of 11x11 pixels, in grey levels;
noise     ratio, after to before the edit, of noise of 5 grey levels in flat areas (the half of the picture with less
          activity), from two realisations of noise;
clipped   pixels with a channel that becomes 0 or 255 but was not before, in percent;
chroma    change of the mean chroma (YCbCr), in percent; in a grey picture, of a hundredth of a level;
mean      change of the mean brightness, in grey levels.

With ``--scales``, one large photograph at 1.5, 6 and 24 megapixels under the same sliders: detail gain of each result
reduced to 1.5 megapixels, and the differences between these results.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.enhancers import clahe, detail_enhance, gaussian, smoothers
from benchmarks.harness import options, row, strength_of
from benchmarks.photographs import luminance, pictures
from nlfilter_torch.photo import enhance
from nlfilter_torch.photo.declared.parameters import DETAIL
from nlfilter_torch.photo.declared.presets import PRESETS
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.pixels import Fitted, part_of
from nlfilter_torch.photo.picture.viewing import within_limits

CHOSEN_ON = ("astronaut", "coffee", "chelsea", "rocket")
SIDE = 320
GAINS = (1.5, 2.0)
RADIUS = 2.0
TEXTURE = (0.5, 0.85)  # quantiles of activity
NOISE = 5 / 255
LEAST_CHROMA = 0.01 / 255  # mean chroma of a grey picture, at most, by the rounding of float32
STRONGEST = 60.0
LARGE = "retina"
FACTORS = (1, 2, 4)  # of the sides
OURS = "nlfilter-torch"

Strength = Callable[[float], Tensor]  # strength to the edited photograph; 0 leaves it unchanged


@dataclass(frozen=True)
class Figures:
    """Measurements of one result."""

    halo: float
    noise: float
    clipped: float
    chroma: float
    mean: float

    @property
    def costs(self) -> tuple[float, float, float]:
        """The measurements that should be small."""
        return (self.halo, self.noise, self.clipped)

    def beats(self, other: "Figures") -> bool:
        """Whether this result dominates another: no measurement is worse, and at least one is better."""
        pairs = list(zip(self.costs, other.costs, strict=True))
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def shown(image: Tensor) -> Tensor:
    """Round an image to 8 bits."""
    return (image.clamp(0, 1) * 255).round() / 255


def fine(y: Tensor) -> Tensor:
    """The part that a Gaussian of 2 pixels removes."""
    return y - gaussian(y, RADIUS)


class Scene:
    """A photograph, noisy versions of it, and the areas to measure in."""

    def __init__(self, image: Tensor) -> None:
        self.image = shown(image)
        draws = torch.randn(2, 1, *image.shape[-2:], generator=torch.Generator().manual_seed(0))
        self.noisy = [(self.image + NOISE * draw).clamp(0, 1) for draw in draws]
        self.fine = fine(luminance(self.image))
        activity = gaussian(self.fine.square(), 2 * RADIUS)
        low, high = (activity.flatten().float().quantile(q) for q in TEXTURE)
        self.texture = (activity >= low) & (activity <= high)
        self.flat = activity < low

    def gain(self, result: Tensor) -> float:
        """Detail gain on mid-strength texture."""
        after = fine(luminance(shown(result)))[self.texture]
        return float((after.square().mean() / self.fine[self.texture].square().mean()).sqrt())

    def figures(self, result: Tensor, noisy: list[Tensor]) -> Figures:
        """Measurements of a result, given the results for the noisy versions."""
        before, after = self.image, shown(result)
        y, z = luminance(before), luminance(after)
        highest, lowest = F.max_pool2d(y, 11, 1, 5), -F.max_pool2d(-y, 11, 1, 5)
        beyond = torch.maximum(z - highest, lowest - z).clamp(min=0)
        noises = [(luminance(a) - luminance(b))[self.flat].std() for a, b in (noisy, self.noisy)]
        newly = ((after <= 0) & (before > 0)) | ((after >= 1) & (before < 1))
        chroma = [(x - luminance(x)).norm(dim=1).mean() for x in (after, before)]
        return Figures(
            255 * float(beyond.flatten().quantile(0.99)),
            float(noises[0] / noises[1]),
            100 * float(newly.any(1).float().mean()),
            100 * float((chroma[0] - chroma[1]) / chroma[1].clamp(min=LEAST_CHROMA)),
            255 * float((z - y).mean()),
        )


def ours(image: Tensor) -> Strength:
    """The detail edit for any strength from a single filter run: it is linear in the sliders before the limits."""
    change = luminance(enhance(image, torch.tensor([2.0, 2.0, 2.0, 1.0]), limits="none")) - luminance(image)
    source = InMemory(image)

    def edit(strength: float) -> Tensor:
        return source.all(within_limits(source, Fitted(part_of(strength * change)), "soft"))

    return edit


def boosted(smooth: Callable[..., object]) -> Callable[[Tensor], Strength]:
    """A method that adds a multiple of the detail removed by a smoothing filter."""

    def of(image: Tensor) -> Strength:
        y = luminance(image)
        detail = y - torch.as_tensor(smooth(y[0, 0].numpy().copy()))[None, None]
        return lambda strength: edit_luminance(image, lambda y: y + strength * detail)

    return of


METHODS: dict[str, Callable[[Tensor], Strength]] = {
    OURS: ours,
    **{name: boosted(smooth) for name, smooth in smoothers().items()},
    "detailEnhance": lambda image: lambda strength: detail_enhance(image, strength),
    "CLAHE": lambda image: (
        lambda strength: edit_luminance(image, lambda y: torch.from_numpy(clahe(y[0, 0].numpy(), strength))[None, None])
    ),
}


def measure(scene: Scene) -> dict[float, dict[str, Figures | None]]:
    """Measure every method for every gain; None if a method does not reach the gain."""
    figures: dict[float, dict[str, Figures | None]] = {gain: {} for gain in GAINS}
    for name, method in METHODS.items():
        clean, *noisy = (method(image) for image in (scene.image, *scene.noisy))
        for gain in GAINS:
            amount = strength_of(lambda strength: scene.gain(clean(strength)), gain, STRONGEST, 12)  # noqa: B023
            if amount is None:
                figures[gain][name] = None
            else:
                figures[gain][name] = scene.figures(clean(amount), [shown(edit(amount)) for edit in noisy])
    return figures


def compare(images: dict[str, Tensor]) -> None:
    """Print a table for each picture and gain, and a summary."""
    lost: list[str] = []
    fronts = least = cases = 0
    worst = [0.0, 0.0]
    means: dict[tuple[float, str], list[Figures]] = {}
    for name, image in images.items():
        for gain, rows in measure(Scene(image)).items():
            print(f"\n{name}, detail gain {gain}")
            print(row("", ["halo", "noise", "clipped", "chroma", "mean"]))
            for method, f in rows.items():
                told = "{halo:.1f} {noise:.2f} {clipped:.2f} {chroma:+.1f} {mean:+.2f}"
                cells = ["not reached"] if f is None else told.format(**asdict(f)).split()
                print(row(method, cells), flush=True)
                if f is not None:
                    means.setdefault((gain, method), []).append(f)
            own = rows[OURS]
            cases += 1
            if own is None:
                lost.append(f"{name}, gain {gain}: not reached")
                continue
            peers = {method: f for method, f in rows.items() if f is not None and method != OURS}
            better = [method for method, f in peers.items() if f.beats(own)]
            fronts += not better
            least += own.clipped <= min((f.clipped for f in peers.values()), default=100.0)
            worst = [max(worst[0], abs(own.chroma)), max(worst[1], abs(own.mean))]
            lost += [f"{name}, gain {gain}: {method} in halo, noise and clipped share" for method in better]
            for i, figure in enumerate(("halo", "noise gain", "clipped share")):
                ahead = [f"{m} {f.costs[i]:.2f}" for m, f in peers.items() if f.costs[i] < own.costs[i]]
                if ahead:
                    lost.append(f"{name}, gain {gain}: {figure} {own.costs[i]:.2f}: {', '.join(ahead)}")
    for gain in GAINS:
        print(f"\nmean of the pictures on which the gain is reached, detail gain {gain}")
        print(row("", ["halo", "noise", "clipped", "reached"]))
        for method in METHODS:
            known = means.get((gain, method), [])
            columns = [sum(f.costs[i] for f in known) / len(known) for i in range(3)] if known else []
            print(row(method, [*(f"{mean:.2f}" for mean in columns), f"{len(known)}/{len(images)}"]))
    print(f"\non the Pareto front of halo, noise gain and clipped share: {fronts} of {cases}")
    print(f"clipped share at most that of the best peer: {least} of {cases}")
    print(f"largest change of chroma {worst[0]:.1f} %, of mean brightness {worst[1]:.2f} levels")
    print("\nlost comparisons\n" + "\n".join(lost or ["none"]))


def compare_scales(name: str, image: Tensor, megapixels: float) -> None:
    """Print the detail gain of every named preset at the viewing size, for pictures of 1, 4 and 16 times that size."""
    print(f"{name}: detail gain at {megapixels:g} megapixels, and RMS difference from the first result in grey levels")
    scale = (megapixels * 1e6 / image[0, 0].numel()) ** 0.5
    viewed = [round(scale * length) for length in image.shape[-2:]]

    def sized(picture: Tensor, factor: int) -> Tensor:
        size = [factor * length for length in viewed]
        return F.interpolate(picture, size, mode="bicubic", antialias=True).clamp(0, 1)

    print(row("", [*(f"{factor**2 * megapixels:g} MP" for factor in FACTORS), "apart", "RMS"]))
    for preset in PRESETS:
        gains, views = [], []
        for factor in FACTORS:
            large = sized(image, factor)
            step = PRESETS[preset].steps[0].changed(viewing_size=megapixels)
            views.append(sized(apply_step(step, large), 1))
            gains.append(Scene(sized(large, 1)).gain(views[-1]))
        apart = 100 * (max(gains) / min(gains) - 1)
        rms = max(255 * float((view - views[0]).square().mean().sqrt()) for view in views)
        print(row(preset, [*(f"{gain:.2f}" for gain in gains), f"{apart:.1f} %", f"{rms:.2f}"]), flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Print tables."""
    parser = options("detail", __doc__, "two photographs at 64 pixels")
    parser.add_argument("--pictures", type=Path, help="folder of photographs; default: those of scikit-image")
    parser.add_argument("--side", type=int, default=SIDE, help="short side in pixels to which they are reduced")
    parser.add_argument("--scales", action="store_true", help="the same presets on one photograph in three sizes")
    chosen = parser.parse_args(arguments)
    names = CHOSEN_ON[:2] if chosen.quick else CHOSEN_ON
    if chosen.scales:
        name, image = next(iter(pictures(chosen.pictures, 1 << 14, (LARGE,)).items()))
        compare_scales(name, image, 0.01 if chosen.quick else DETAIL["viewing_size"].default)
    else:
        compare(pictures(chosen.pictures, 64 if chosen.quick else chosen.side, names))


if __name__ == "__main__":
    main()
