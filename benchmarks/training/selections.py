"""Training of the network of selections: ``python -m benchmarks.training.selections --pictures FOLDER --out FOLDER``.

Cases are objects of ``outlines.json`` with random strokes, and with a box in a third of them, as the model sees them;
these objects over other photographs of the training set, sometimes twice, of which one is meant; and composites like
those of :mod:`benchmarks.masks`. They are kept in ``OUT/cases``, so that the command goes on where it was stopped. Then
it trains without each fifth of the photographs with outlines in turn, prints the mean IoU of the model's masks of the
objects that were left out, and that of the network, and trains on all of them. Only photographs of
:mod:`benchmarks.free_photographs` are used, whose licences allow it; ``OUT/object_network.safetensors`` may be shipped.
"""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import mean
from unittest.mock import patch

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor

from benchmarks import composites
from benchmarks.free_photographs import photographs
from benchmarks.harness import options
from benchmarks.outlines import Mask, filled, outlines
from benchmarks.photographs import reduced_to
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.selections import object_model
from nlfilter_torch.photo.selections.mask import RegionMask
from nlfilter_torch.photo.selections.object_network import (
    EVIDENCE_PLANES,
    SHAPES,
    coarse_evidence,
    correction_of,
    features,
    odds_of,
)

SHORT, BLOB_SEED = 426, 50_000  # as benchmarks.masks; no seed of its own
SEEN = 1 << 17  # pixels of the pictures in which masks are made
BLOBS, BLOB_STROKES = 150, (1, 3)  # further composites, of shapes without meaning, and their strokes on each side
STROKES, COMPOSITES = 10, 4  # random sets of strokes per object, in its photograph and over each of two others
SAMPLED = 400  # pixels of each case
SHARES = {"real": 1.0, "first": 0.5, "second": 0.5, "blob": 0.25}  # of files in the training
STEPS, BATCH, RATE, DECAY, NOISE = 2000, 12, 3e-3, 3e-2, 0.05
NEARBY, BOXED, PARTS = 0.5, 0.33, 5  # share of strokes outside near the object, and of boxes; parts of photographs
EVIDENCE = sum(EVIDENCE_PLANES)
OBJECT = RegionMask.of(MASK.defaults | {"extent": "object"})

Plane = NDArray[np.float32]


class RecordedError(Exception):
    """What the model knows is recorded; no mask is needed."""


def evidence(source: InMemory, inside: Tensor, outside: Tensor | None, box: tuple[int, ...] | None) -> Tensor:
    """What the network is given for an object, (18, h, w)."""
    seen = list[Tensor]()

    def record(planes: Tensor) -> Tensor:
        seen.append(planes)
        raise RecordedError

    marks = {"scribbles": inside} if outside is None else {"scribbles": inside, "background": outside}
    with patch.object(object_model, "corrected", record), suppress(RecordedError):
        OBJECT.fit(source, Drawn(marks, box=box))
    return seen[0].float()


def cases(image: Tensor, wanted: Mask, either: Mask, count: int, random: np.random.Generator) -> Iterator[Tensor]:
    """Evidence, the object, and what counts, (20, h, w) in float16, for random strokes and boxes.

    Args:
        image: (1, 3, H, W).
        wanted: the object, (H, W).
        either: what does not count, (H, W).
        count: of cases.
        random: their source.
    """
    size, source = wanted.shape, InMemory(image, {})
    short = min(size)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(1, round(0.01 * short)) + 1,) * 2)
    inner, outer = ((cv2.erode(side.astype(np.uint8), disc) > 0) & ~either for side in (wanted, ~wanted))
    ring = outer & (cv2.dilate(wanted.astype(np.uint8), np.ones((3, 3)), iterations=max(3, round(0.12 * short))) > 0)
    rows, columns = (np.flatnonzero(wanted.any(axis)) for axis in (1, 0))
    for _ in range(count if inner.sum() >= 30 else 0):
        length, radius = (
            math.exp(random.uniform(math.log(0.05), math.log(0.4))),
            random.choice([0.008, 0.01, 0.014, 0.02]),
        )
        with patch.multiple(composites, LENGTH=length, RADIUS=radius):
            inside = composites.draw_strokes(inner, int(random.integers(1, 5)), random)
            allowed = ring if random.random() < NEARBY and ring.sum() > 100 else outer
            number = int(random.choice([0, 0, 1, 2, 3, 4, 4]))
            outside = composites.draw_strokes(allowed, number, random) if number else None
        box = None
        if random.random() < BOXED:
            left, top, right, below = random.uniform(0.005, 0.06, 4) * short
            box = (
                max(0, int(columns[0] - left)),
                max(0, int(rows[0] - top)),
                min(size[1], int(columns[-1] + 1 + right)),
                min(size[0], int(rows[-1] + 1 + below)),
            )
        yield judged(evidence(source, inside, outside, box), np.float32(wanted), ~either)


def judged(planes: Tensor, alpha: Plane, counted: Mask) -> Tensor:
    """Evidence with the opacity of its object and with what counts, in float16."""
    truth = torch.from_numpy(np.stack([alpha, counted.astype(np.float32)]))
    return torch.cat([planes, F.interpolate(truth.unsqueeze(0), planes.shape[-2:], mode="area")[0]]).half()


def over(image: Tensor, wanted: Mask, back: Tensor, random: np.random.Generator) -> tuple[Tensor, Mask]:
    """An object of a photograph over another one, at times twice, and where it is, (H, W), without the second."""
    rows, columns = (np.flatnonzero(wanted.any(axis)) for axis in (1, 0))
    part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    height, width = back.shape[-2:]
    extent = (part[0].stop - part[0].start, part[1].stop - part[1].start)
    share = random.uniform(0.3, 0.8) * min(height / extent[0], width / extent[1])
    size = (max(8, int(extent[0] * share)), max(8, int(extent[1] * share)))
    method = cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC
    thing = cv2.resize(image[0].permute(1, 2, 0).numpy()[part], size[::-1], interpolation=method)
    alpha = cv2.resize(wanted[part].astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA).clip(0, 1)
    alpha = cv2.GaussianBlur(alpha, (0, 0), 0.7)
    if random.random() < 0.5:
        thing, alpha = thing[:, ::-1], alpha[:, ::-1]
    result, whole = back[0].permute(1, 2, 0).numpy().copy(), np.zeros((height, width), np.float32)
    for number in range(2 if random.random() < 0.25 else 1):
        top, left = (int(random.integers(0, most + 1)) for most in (height - size[0], width - size[1]))
        place = (slice(top, top + size[0]), slice(left, left + size[1]))
        if number and whole[place].any():
            break
        opacity = alpha[..., None]
        result[place] = opacity * (thing * random.uniform(0.85, 1.15)) + (1 - opacity) * result[place]
        if not number:
            whole[place] = alpha
    return torch.from_numpy(result).permute(2, 0, 1)[None].clamp(0, 1).contiguous(), whole > 0.5


def blobs(images: dict[str, Tensor], seed: int) -> Iterator[Tensor]:
    """Cases of a composite as those of :mod:`benchmarks.masks`, (20, h, w) in float16."""
    (made,) = composites.composites(1, seed, images, composites.SIZE)
    source, alpha = InMemory(made.image, {}), made.alpha[0, 0].numpy()
    for count in BLOB_STROKES:
        for opposed in (False, True):
            inside, outside = made.scribbles(count, seed + count)
            yield judged(evidence(source, inside, outside if opposed else None, None), alpha, np.ones_like(alpha) > 0)


def seen(image: Tensor) -> Tensor:
    """A photograph at the size at which masks are made."""
    height, width = image.shape[-2:]
    return reduced_to(image, int(min(height, width) * min(1.0, math.sqrt(SEEN / (height * width)))))


def gather(pictures: Path, folder: Path) -> None:
    """Write the cases of each object as KIND-NUMBER.pt, and those of blobs, unless they are there."""
    listed = [outline for outline in outlines() if outline.set == "training"]
    backs = [entry for entry in photographs() if entry.set == "training"]
    folder.mkdir(parents=True, exist_ok=True)
    for turn, kind in enumerate(SHARES):
        for number, outline in enumerate(listed) if turn < 3 else ():
            file = folder / f"{kind}-{number:03}.pt"
            if file.exists():
                continue
            random = np.random.default_rng([turn, number])
            picture = seen(outline.job.before(pictures))
            size = (picture.shape[-2], picture.shape[-1])
            wanted, either = outline.object(size), filled(outline.either, size)
            if turn:
                back = backs[random.choice([k for k, o in enumerate(backs) if o.name != outline.job.photograph])]
                picture, wanted = over(picture, wanted & ~either, seen(back.pixels(pictures)), random)
                either = np.zeros_like(wanted)
            save(list(cases(picture, wanted, either, COMPOSITES if turn else STROKES, random)), file)
    images: dict[str, Tensor] = {}
    for number in range(BLOBS):
        file = folder / f"blob-{number:03}.pt"
        if not file.exists():
            images = images or {entry.name: reduced_to(entry.pixels(pictures), SHORT) for entry in backs}
            save(list(blobs(images, BLOB_SEED + number)), file)


def save(made: list[Tensor], file: Path) -> None:
    """Write cases, if there are any."""
    if made:
        torch.save(torch.stack(made), file)
        print(file.name, len(made), flush=True)


def coarse(case: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What the network sees of a case (20, h, w), the object's opacity, and what counts, at its resolution."""
    planes, truth = case.float().split([EVIDENCE, 2])
    seen_planes = coarse_evidence(planes)
    wanted, counted = F.adaptive_avg_pool2d(truth, seen_planes.shape[-2:])
    return seen_planes, wanted, counted


def sampled(case: Tensor, generator: torch.Generator) -> Tensor:
    """Features, log odds of the model, truth and weight of random pixels of a case, (SAMPLED, F + 3), in float16.

    Those near the model's border, or where it is wrong, are drawn more often, and weigh less in return.
    """
    planes, wanted, counted = coarse(case)
    odds = odds_of(planes[EVIDENCE - 1])
    weight = counted / ((wanted * counted).sum() + 0.05 * counted.sum())
    hard = (odds.abs() < 3) | ((odds > 0) != (wanted > 0.5))
    chance = (0.3 + hard.float()) * (counted > 0.5)
    chance = (chance / chance.sum()).flatten()
    drawn = torch.multinomial(chance, SAMPLED, generator=generator)
    columns = [odds, wanted, weight / chance.view_as(weight).clamp(min=1e-12) / SAMPLED]
    return torch.cat([features(planes), torch.stack(columns)]).flatten(1)[:, drawn].mT.half()


def loss_of(odds: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """1 - IoU of soft masks, and a part of their cross entropy relative to the object's area, (cases, pixels)."""
    mask = odds.sigmoid()
    overlap = (weight * mask * truth).sum(1) / (weight * (mask + truth - mask * truth)).sum(1).clamp(min=1e-6)
    entropy = (F.binary_cross_entropy_with_logits(odds, truth, reduction="none") * weight).sum(1)
    return (1 - overlap + 0.15 * entropy.clamp(max=4.0)).mean()


def train(data: Tensor, shares: Tensor, seed: int) -> dict[str, Tensor]:
    """Weights learned from the pixels of cases (n, SAMPLED, F + 3), which are drawn by their shares (n,)."""
    generator = torch.Generator().manual_seed(seed)
    weights = {name: torch.zeros(shape) for name, shape in SHAPES.items()}
    for name in ("first", "second"):
        bound = SHAPES[f"{name}.weight"][1] ** -0.5
        for part in ("weight", "bias"):
            weights[f"{name}.{part}"].uniform_(-bound, bound, generator=generator)
    weights["scale"].fill_(1.0)
    points = data[:, ::37, : SHAPES["mean"][0]].float().flatten(0, 1)
    weights["mean"], weights["std"] = points.mean(0), points.std(0) + 0.02
    learned = [weights[name].requires_grad_() for name in SHAPES if name not in ("mean", "std")]
    means = [weight.detach().clone() for weight in learned]
    optimizer = torch.optim.AdamW(learned, lr=RATE, weight_decay=DECAY)
    order = torch.multinomial(shares, STEPS * BATCH, replacement=True, generator=generator)
    for step, chosen in enumerate(order.view(STEPS, BATCH)):
        optimizer.param_groups[0]["lr"] = (
            RATE * min(1.0, (step + 1) / 20) * (0.5 + 0.5 * math.cos(math.pi * step / STEPS))
        )
        points, odds, truth, weight = data[chosen].float().split([SHAPES["mean"][0], 1, 1, 1], dim=2)
        noise = torch.randn(points.shape, generator=generator) + torch.randn(
            BATCH, 1, points.shape[2], generator=generator
        )
        corrected = correction_of(points + NOISE * weights["std"] * noise, weights) + weights["scale"] * odds.squeeze(2)
        optimizer.zero_grad()
        loss_of(corrected, truth.squeeze(2), weight.squeeze(2)).backward()
        optimizer.step()
        for average, value in zip(means, learned, strict=True):
            average.lerp_(value.detach(), max(0.02, 9 / (step + 10)))
    named = [name for name in SHAPES if name not in ("mean", "std")]
    return {name: weights[name].detach() for name in ("mean", "std")} | dict(zip(named, means, strict=True))


@torch.no_grad()
def judge(made: Sequence[Tensor], weights: dict[str, Tensor]) -> tuple[float, float]:
    """Mean IoU of the masks of the model, and of the network before the last cut, of cases (20, h, w)."""
    scores = []
    for planes, wanted, counted in map(coarse, made):
        odds, sides = odds_of(planes[EVIDENCE - 1]), (wanted > 0.5, counted > 0.5)
        by_network = correction_of(features(planes).movedim(0, -1), weights) + weights["scale"] * odds
        parts = [((mask > 0) & sides[1], sides[0] & sides[1]) for mask in (odds, by_network)]
        scores.append([float((mask & side).sum() / (mask | side).sum()) for mask, side in parts])
    model, network = (mean(column) for column in zip(*scores, strict=True))
    return model, network


def main(arguments: list[str] | None = None) -> int:
    """Gather cases, train and judge without each part of the photographs in turn, train on all, write the weights."""
    parser = options("training.selections", __doc__)
    parser.add_argument("--pictures", type=Path, required=True, help="folder of free photographs")
    parser.add_argument("--out", type=Path, required=True, help="folder for cases and weights")
    chosen = parser.parse_args(arguments)
    gather(chosen.pictures, chosen.out / "cases")
    listed = [outline for outline in outlines() if outline.set == "training"]
    names = sorted({outline.job.photograph for outline in listed})
    generator, files = torch.Generator().manual_seed(0), sorted((chosen.out / "cases").glob("*.pt"))
    made = [torch.stack([sampled(case, generator) for case in torch.load(file)]) for file in files]
    kinds, numbers = zip(*(file.stem.split("-") for file in files), strict=True)
    parts = [
        names.index(listed[int(number)].job.photograph) % PARTS if kind != "blob" else PARTS
        for kind, number in zip(kinds, numbers, strict=True)
    ]
    found = []
    for left_out in range(PARTS + 1):  # none in the last turn
        used = [k for k, part in enumerate(parts) if part != left_out or left_out == PARTS]
        shares = [torch.full((len(made[k]),), SHARES[kinds[k]] / len(made[k])) for k in used]
        weights = train(torch.cat([made[k] for k in used]), torch.cat(shares), left_out)
        aside = [
            file for file, kind, part in zip(files, kinds, parts, strict=True) if (kind, part) == ("real", left_out)
        ]
        found += [judge(torch.load(file), weights) for file in aside]
    model, network = (mean(column) for column in zip(*found, strict=True))
    print(f"mean IoU of {len(found)} objects left out: model {model:.3f}, network {network:.3f}")
    save_file(
        {name: weight.contiguous() for name, weight in weights.items()}, chosen.out / "object_network.safetensors"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
