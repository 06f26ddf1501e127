"""How exact masks from scribbles are, beside matting and segmentation: ``python -m benchmarks.masks``.

Composites with known opacity (:mod:`benchmarks.composites`), with 1, 2 and 4 scribbles on each side, and on the object
alone. Reports the mean squared error of the mask, and the intersection over union of its values above 0.5, for
:func:`region_mask` and each method of :mod:`benchmarks.mask_peers`; how often :func:`region_mask` is better than each,
its largest losses, and its time. Then the errors in the unknown bands of wide trimaps, in which everything else is
painted. ``--set choosing`` uses the photographs and seeds that its defaults were chosen on.
"""

import statistics
from collections.abc import Iterable

import torch
from torch import Tensor

from benchmarks.composites import Composite, composites, setup
from benchmarks.harness import medians, row
from benchmarks.mask_peers import PEERS
from benchmarks.photographs import photograph
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.selections.mask import RegionMask

OURS = "region_mask"
COUNTS = (1, 2, 4)
WON = 0.6  # required share of cases in which each peer is beaten
MEGAPIXEL = 1024
TRIMAP_SCALE = 3  # their composites are larger than those of scribbles
METHODS = {OURS: region_mask, **PEERS}
Score = tuple[float, float]


def score(estimate: Tensor, wanted: Tensor) -> Score:
    """Mean squared error, and intersection over union, of a mask (1, 1, H, W) against the true one."""
    both, either = (estimate > 0.5) & (wanted > 0.5), (estimate > 0.5) | (wanted > 0.5)
    return float((estimate - wanted).square().mean()), float(both.sum() / either.sum())


def measure(composite: Composite, count: int, seed: int) -> dict[str, Score]:
    """Score every method with ``count`` scribbles on each side; the key "alone" has none on the background."""
    inside, outside = composite.scribbles(count, seed)
    scores = {
        name: score(method(composite.image, inside, outside), composite.alpha) for name, method in METHODS.items()
    }
    return {"alone": score(region_mask(composite.image, inside), composite.alpha), **scores}


def report_trimaps(chosen: Iterable[Composite]) -> None:
    """Print the mean and largest squared error of every method in the unknown bands of trimaps."""
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    for composite in chosen:
        inside, outside = composite.trimap()
        unknown = inside + outside == 0
        if not (inside.any() and outside.any()):  # hairs or holes may leave no certain pixel
            continue
        for name, method in METHODS.items():
            mask = method(composite.image, inside, outside)
            errors[name].append(float((mask - composite.alpha)[unknown].square().mean()))
    print(f"\n{len(errors[OURS])} wide trimaps, squared error where they are unknown\n{'':14}{'mean':>8}{'most':>8}")
    for name, values in errors.items():
        print(f"{name:14}{statistics.mean(values):8.4f}{max(values):8.4f}")


def report(cases: dict[str, dict[str, Score]]) -> bool:
    """Print means, wins and worst losses; return whether it is best in the mean and wins often enough."""
    print(row("", ["MSE", "IoU", "beaten in MSE", "in IoU"], 15, 14))
    means, won = {}, []
    for name in ("alone", *METHODS):
        means[name] = [statistics.mean(column) for column in zip(*(case[name] for case in cases.values()), strict=True)]
        cells = [f"{means[name][0]:.4f}", f"{means[name][1]:.3f}"]
        if name in PEERS:
            less = statistics.mean(case[OURS][0] < case[name][0] for case in cases.values())
            more = statistics.mean(case[OURS][1] > case[name][1] for case in cases.values())
            won += [less, more]
            cells += [f"{less:.0%}", f"{more:.0%}"]
        print(row(name, cells, 15, 14))
    lost = [(case[OURS][0] - case[name][0], key, name) for key, case in cases.items() for name in PEERS]
    lost = sorted((entry for entry in lost if entry[0] > 0), reverse=True)
    print(f"lost {len(lost)} of {len(cases) * len(PEERS)} comparisons of MSE; those lost by most:")
    for lead, key, name in lost[:12]:
        print(f"  {key:52} {OURS} {cases[key][OURS][0]:.4f}, {name} {cases[key][name][0]:.4f} ({lead:.4f} less)")
    best = all(means[OURS][0] < means[name][0] and means[OURS][1] > means[name][1] for name in PEERS)
    return best and min(won) >= WON


def speed(side: int) -> None:
    """Print the time of a first mask of a photograph, and of a further scribble with the cached operator."""
    image = photograph("astronaut", side, side)
    inside, outside = torch.zeros(1, 1, side, side), torch.zeros(1, 1, side, side)
    inside[..., side // 2 : side // 2 + side // 20, side // 2 :][..., : side // 10] = 1
    outside[..., : side // 20, : side // 10] = 1
    source = InMemory(image.to(working_dtype(image)), {})
    edit = RegionMask.of(MASK.defaults)
    marks = {"scribbles": inside, "background": outside}
    source.all(edit.fit(source, Drawn(marks)))  # caches the operator

    def add_scribble() -> Tensor:
        free = (outside[0, 0] == 0).nonzero()[0]
        outside[0, 0, free[0] :, free[1] :][:10, :10] = 1  # otherwise the last mask would be returned
        return source.all(edit.fit(source, Drawn(marks)))

    calls = {"first": lambda: region_mask(image, inside, outside), "further": add_scribble}
    first, further = medians(calls, 3).values()
    print(f"{side}x{side} on {torch.get_num_threads()} threads: {first:.2f} s, a further scribble {further:.2f} s")


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    chosen, cases = setup("masks", __doc__, arguments), {}
    for number, composite in enumerate(composites(chosen.count, chosen.first, chosen.images, chosen.size)):
        for scribbles in COUNTS:
            key = f"{number} {composite.name}, {scribbles} scribbles"
            cases[key] = measure(composite, scribbles, chosen.first + 10 * number + scribbles)
    count, size = chosen.count, chosen.size
    for scribbles in COUNTS:
        print(f"\n{count} composites of {size[0]}x{size[1]}, {scribbles} scribbles on each side ({chosen.kind} set)")
        report({key: case for key, case in cases.items() if key.endswith(f", {scribbles} scribbles")})
    print(f"\nall {len(cases)}")
    holds = report(cases)
    if not chosen.quick:
        print(f"best in both means, and {WON:.0%} against each: {'holds' if holds else 'FALLS SHORT'}")
    larger = (TRIMAP_SCALE * chosen.size[0], TRIMAP_SCALE * chosen.size[1])
    report_trimaps(composites(chosen.count, chosen.first, chosen.images, larger))
    speed(64 if chosen.quick else MEGAPIXEL)


if __name__ == "__main__":
    main()
