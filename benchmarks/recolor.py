"""How much of an object recolouring and defocus reach, and what beside it: ``python -m benchmarks.recolor``.

Measured on composites (:mod:`benchmarks.composites`). For recolouring, the object has one strong colour: it is the
texture of its photograph, tinted. The expected result is the composite of the recoloured object. "Covered" is the share
of the object that changes by at least half of the expected change, "outside" the share of the background that changes
by more than two grey levels, and "border" the RMS error at the border, in grey levels. For defocus, "kept" is the share
of the object that stays in focus, "blurred" the share of the background that does not, and "halo" the error beside the
object, compared with a background that is blurred alone.

The object's texture in the painted colour is known exactly, since it was tinted: "lit" is the mean difference in CIELAB
in the object's light part, "shade" where it has at most 0.8 times the light under the scribble, and "neutral" in grey
surroundings, which must not change; "own" is the same with ``brightness=0``, and "before" that of the object as it was.
Where the painted texture leaves [0, 1], it is clipped in the expected result.

Hats of several colours are put on the photograph of an astronaut and recoloured with one scribble. Printed are the
shares of the hat, and of face, lips and suit beside it, that change, with each of two extents.

Blotches are measured in smooth areas of the photographs themselves, such as skies: connected areas without borders, of
about one colour, in which one scribble is drawn. "Covered" is as above, "spread" the standard deviation of the new
colour over the area (a* and b* of CIE Lab), "even" what it would be if the whole area were recoloured, and "before"
that of the old colour.

``--set choosing`` takes the photographs and seeds that the defaults were chosen on.
"""

import math
import statistics
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from benchmarks.composites import Composite, composites, draw_strokes, setup
from benchmarks.photographs import photograph
from nlfilter_torch.photo import defocus, recolor
from nlfilter_torch.photo.edits.defocus import Lens, convolve
from nlfilter_torch.photo.edits.recolor import Recoloring, with_room
from nlfilter_torch.photo.picture.colour import hundredths_of_lab, merge_luminance, split_luminance
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.viewing import viewed_size
from nlfilter_torch.photo.selections.border_colours import colours_beside
from nlfilter_torch.photo.selections.connected import Extent

TINTS = ((0.8, 0.2, 0.15), (0.2, 0.35, 0.8), (0.2, 0.6, 0.25), (0.85, 0.7, 0.15))
COLOURS = ((0.1, 0.3, 0.9), (0.9, 0.5, 0.1), (0.7, 0.15, 0.7), (0.15, 0.6, 0.3))  # of the scribbles, for each tint
RADIUS = 0.03  # of the blur, as a share of the short side
BESIDE = 0.06  # width of the area beside the object, as a share of the short side
CHANGED = 2 / 255
SHADED = 0.8  # light of shade, relative to that under the scribble
NEUTRAL = 8  # largest a* and b* of grey, in CIELAB
AREA_SIZE = 0.13  # megapixels to which photographs are reduced for smooth areas
# Smooth areas: blur and distance to borders as shares of the short side, largest change of colour along that distance,
# largest differences from the colour of the innermost pixel in lightness and in a* and b*, all in units of Lab, and
# smallest share of the photograph.
SMOOTH_BLUR, SMOOTH_MARGIN, SMOOTH_CHANGE = 0.006, 0.008, 1.7
SMOOTH_LIGHTNESS, SMOOTH_COLOUR, SMOOTH_SHARE = 30, 15, 0.1
HATS = ((0.85, 0.1, 0.12), (0.9, 0.45, 0.3), (0.85, 0.35, 0.45), (0.75, 0.2, 0.5), (0.95, 0.65, 0.1))
HAT_EXTENTS: tuple[Extent, ...] = ("near", "object")
BESIDE_HAT = {  # rows and columns
    "face": (slice(112, 205), slice(185, 262)),
    "lips": (slice(167, 185), slice(208, 248)),
    "suit": (slice(300, 400), slice(40, 120)),
}
LIMITS = {"covered": 90.0, "outside": 10.0, "outside, keep": 5.0, "border": 20.0, "kept": 85.0, "kept, two": 95.0}


def tinted(composite: Composite, number: int) -> Composite:
    """The composite, with an object of one colour."""
    tint = torch.tensor(TINTS[number % len(TINTS)]).view(1, 3, 1, 1)
    grey = split_luminance(composite.object)[0]
    thing = ((0.45 + 0.8 * (grey - grey.mean())) / 0.45 * tint).clamp(0, 1)
    image = composite.alpha * thing + (1 - composite.alpha) * composite.background
    return replace(composite, image=image, object=thing)


def recoloured(composite: Composite, colour: Tensor, under: Tensor) -> Tensor:
    """The expected result: the composite of the object in its new colour."""
    chroma = split_luminance(colour.expand_as(composite.image))[1]
    brightness, old = (((part * under).sum((2, 3)) / under.sum())[:, None] for part in split_luminance(composite.image))
    new = with_room(chroma[:, None, :, 0, 0], brightness)
    change = Recoloring(new, old, torch.ones(1, 1, dtype=torch.bool), brightness)
    within = torch.ones_like(composite.alpha)
    thing = change(composite.object, within, [colours_beside(split_luminance(composite.object)[1], within)])
    mixed = composite.alpha * thing + (1 - composite.alpha) * composite.background
    # Only colour is compared, so luminance is that of the photograph.
    return merge_luminance(split_luminance(composite.image)[0], split_luminance(mixed)[1])


def rms(difference: Tensor, where: Tensor) -> float:
    """RMS difference in grey levels over a weighted set of pixels."""
    return 255 * float((difference.square().mean(1, keepdim=True) * where).sum() / where.sum()) ** 0.5


def measure_recolor(
    composite: Composite, number: int, count: int, seed: int, *, keep: bool, extent: Extent = "object"
) -> dict[str, float]:
    """Measure one recolouring: shares in percent, and errors."""
    scene = tinted(composite, number)
    inside = scene.scribbles(count, seed)[0]
    colour = torch.tensor(COLOURS[number % len(COLOURS)]).view(1, 3, 1, 1)
    kept = scene.scribbles(1, seed + 1)[1] if keep else None
    result = recolor(
        scene.image, (colour * inside).expand_as(scene.image), inside, keep=kept, extent=extent, brightness=0.0
    )
    wanted = recoloured(scene, colour, inside)
    change, ideal = result - scene.image, wanted - scene.image
    along = (change * ideal).sum(1, keepdim=True) / ideal.square().sum(1, keepdim=True).clamp(min=1e-8)
    core, ground = (scene.alpha > 0.98).float(), (scene.alpha < 0.02).float()
    border = 1 - core - ground
    visible = core * (ideal.abs().amax(1, keepdim=True) > CHANGED)
    return {
        "covered": 100 * float(((along > 0.5) * visible).sum() / visible.sum()),
        "outside": 100 * float(((change.abs().amax(1, keepdim=True) > CHANGED) * ground).sum() / ground.sum()),
        "border": rms(result - wanted, border),
        "nothing": rms(ideal, border),
    }


def hat_scene(tint: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
    """A photograph (1, 3, 512, 512) of an astronaut in a hat of that colour with a texture, and the hat (1, 1, ...)."""
    image, texture = photograph("astronaut"), photograph("gravel")
    rows, columns = torch.meshgrid(torch.arange(512.0), torch.arange(512.0), indexing="ij")
    inside = (((rows - 70) / 62) ** 2 + ((columns - 227) / 82) ** 2 < 1) & (rows < 105)
    hat, cloth = (avg_pool2d(planes, 3, 1, 1) for planes in (inside.float()[None, None], texture))
    shade = (0.75 + 0.5 * (cloth - cloth.mean())) * (1.1 - 0.4 * rows / 140)
    colour = (torch.tensor(tint).view(1, 3, 1, 1) * shade).clamp(0, 1)
    return hat * colour + (1 - hat) * image, hat


def measure_hat(tint: tuple[float, float, float]) -> dict[str, float]:
    """Shares in percent of a hat, and of face, lips and suit beside it, that one scribble on the hat changes."""
    image, hat = hat_scene(tint)
    inside = torch.zeros_like(hat)
    inside[..., 50:70, 190:240] = 1
    strokes = torch.tensor(COLOURS[3]).view(1, 3, 1, 1).expand_as(image)
    shares = {}
    for extent in HAT_EXTENTS:
        changed = (recolor(image, strokes, inside, extent=extent, brightness=0.0) - image).abs().amax(1)[0] > CHANGED
        parts = {"hat": hat[0, 0] > 0.98} | BESIDE_HAT
        shares |= {f"{name}, {extent}": 100 * float(changed[part].float().mean()) for name, part in parts.items()}
    return shares


def measure_brightness(composite: Composite, number: int, seed: int) -> dict[str, float]:
    """Differences (CIELAB) in light, shade and grey surroundings: by default, with own brightness, and before."""
    scene = tinted(composite, number)
    inside = scene.scribbles(1, seed)[0]
    tint, colour = (torch.tensor(table[number % len(table)]).view(1, 3, 1, 1) for table in (TINTS, COLOURS))
    # The colour is that of the texture where it is painted, not of the mean texture.
    texture = (scene.object / tint).mean(1, keepdim=True)
    lit = texture / ((texture * inside).sum() / inside.sum())
    thing, before = (colour * lit).clamp(0, 1), 100 * hundredths_of_lab(scene.image)
    core, grey = scene.alpha > 0.98, before[:, 1:].norm(dim=1, keepdim=True) < NEUTRAL
    parts = {"lit": core & (lit > SHADED), "shade": core & (lit <= SHADED), "neutral": (scene.alpha < 0.02) & grey}
    wanted = 100 * hundredths_of_lab(torch.where(core, thing, scene.image))
    painted = (colour * inside).expand_as(scene.image)
    results = {
        "": recolor(scene.image, painted, inside),
        ", own": recolor(scene.image, painted, inside, brightness=0.0),
        ", before": scene.image,
    }
    measured = {}
    for name, result in results.items():
        difference = (100 * hundredths_of_lab(result) - wanted).norm(dim=1, keepdim=True)
        for part, where in parts.items():
            measured[part + name] = float(difference[where].mean())  # not a number where nothing is in shade
    return measured


def measure_defocus(composite: Composite, count: int, seed: int) -> dict[str, float]:
    """Measure one defocus: shares in percent, and errors."""
    inside, _ = composite.scribbles(count, seed)
    radius = RADIUS * min(composite.image.shape[-2:])
    probe = torch.cat([composite.image, composite.alpha], dim=1)
    result = defocus(composite.image, inside, radius=radius)
    kernel = Lens(radius, "disc").kernel().float()
    ones = convolve(torch.ones_like(composite.alpha), kernel)
    behind = convolve(composite.background, kernel) / ones
    wanted = composite.alpha * composite.object + (1 - composite.alpha) * behind
    blurred = convolve(composite.image, kernel) / ones
    step = (composite.image - blurred).abs().mean(1, keepdim=True)
    sharp = ((result - blurred).abs().mean(1, keepdim=True) / step.clamp(min=1e-6)).clamp(0, 1)
    core, ground = composite.alpha > 0.98, composite.alpha < 0.02
    near = torch.nn.functional.max_pool2d(probe[:, 3:], 2 * round(BESIDE * min(step.shape[-2:])) + 1, 1,
                                          round(BESIDE * min(step.shape[-2:])))  # fmt: skip
    beside = (ground & (near > 0.5)).float()
    seen = step > CHANGED  # where blur is visible
    return {
        "kept": 100 * float((sharp > 0.5)[core & seen].float().mean()),
        "blurred": 100 * float((sharp < 0.5)[ground & seen].float().mean()),
        "halo": rms(result - wanted, beside),
        "plain": rms(blurred - wanted, beside),
    }


def smooth_area(image: Tensor) -> NDArray[np.bool_] | None:
    """Find the largest smooth area (H, W) of about one colour in a photograph (1, 3, H, W), if there is one."""
    lab = 100 * hundredths_of_lab(image)[0].permute(1, 2, 0).numpy()
    short = min(lab.shape[:2])
    lab = cv2.GaussianBlur(lab, (0, 0), SMOOTH_BLUR * short)
    slope = np.sqrt(sum(np.square(part).sum(2) for part in np.gradient(lab, axis=(0, 1))))
    size = 2 * round(SMOOTH_MARGIN * short) + 1
    flat = (slope * SMOOTH_MARGIN * short < SMOOTH_CHANGE).astype(np.uint8)
    flat = cv2.erode(flat, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    labels, areas = cv2.connectedComponentsWithStats(flat)[1:3]
    if len(areas) < 2:
        return None
    connected = labels == 1 + areas[1:, 4].argmax()
    depth = cv2.distanceTransform(np.pad(connected, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    middle = np.unravel_index(depth.argmax(), depth.shape)
    difference = np.abs(lab - lab[middle])
    alike = (difference[..., 0] < SMOOTH_LIGHTNESS) & (np.hypot(*difference[..., 1:].T).T < SMOOTH_COLOUR)
    labels = cv2.connectedComponents((connected & alike).astype(np.uint8))[1]
    area: NDArray[np.bool_] = labels == labels[middle]
    return area if area.mean() >= SMOOTH_SHARE else None


def measure_smooth(image: Tensor, area: NDArray[np.bool_], number: int, seed: int) -> dict[str, float]:
    """Measure the recolouring of a smooth area by one scribble: share in percent, and standard deviations."""
    inside = draw_strokes(area, 1, np.random.default_rng(seed))
    colour = torch.tensor(COLOURS[number % len(COLOURS)]).view(1, 3, 1, 1)
    result = recolor(image, (colour * inside).expand_as(image), inside, brightness=0.0)
    whole = Composite("", image, torch.ones_like(inside), image, image)
    before, even, after = (
        100 * hundredths_of_lab(part)[0, 1:, torch.from_numpy(area)]
        for part in (image, recoloured(whole, colour, inside), result)
    )
    ideal = (even - before).square().sum(0)
    visible = ideal > 1  # a distance of 1 in Lab is just noticeable
    along = ((after - before) * (even - before)).sum(0)[visible] / ideal[visible]
    spreads = {
        name: float(part.std(1).norm()) for name, part in (("spread", after), ("even", even), ("before", before))
    }
    return {"covered": 100 * float((along > 0.5).float().mean()), **spreads}


def report(title: str, cases: list[dict[str, float]], limits: dict[str, str]) -> None:
    """Print means, the worst tenth, and the share of cases within each limit."""
    print(f"\n{title}: mean, worst tenth, of {len(cases)}")
    for name in cases[0] if cases else ():
        values = sorted(case[name] for case in cases if not math.isnan(case[name]))
        if not values:
            continue
        high = name in ("covered", "kept", "blurred")
        tenth = values[len(values) // 10] if high else values[-1 - len(values) // 10]
        line = f"  {name:12}{statistics.mean(values):8.1f}{tenth:8.1f}"
        if name in limits:
            limit = LIMITS[limits[name]]
            held = [v >= limit if high else v <= limit for v in values]
            verdict = statistics.mean(values) >= limit if high else statistics.mean(values) <= limit
            line += f"   {'at least' if high else 'at most'} {limit:g}: {'holds' if verdict else 'FALLS SHORT'}"
            line += f" in the mean, {statistics.mean(held):.0%} of cases"
        print(line)


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    chosen = setup("recolor", __doc__, arguments)
    first = chosen.first + 1000
    scenes = list(enumerate(composites(chosen.count, first, chosen.images, chosen.size)))
    print(f"{chosen.count} composites of {chosen.size[0]}x{chosen.size[1]} ({chosen.kind} set)")
    single = [measure_recolor(scene, i, 1, first + 10 * i, keep=False) for i, scene in scenes]
    report("recolor, one scribble", single, {"covered": "covered", "outside": "outside", "border": "border"})
    alike = [measure_recolor(scene, i, 1, first + 10 * i, keep=False, extent="near") for i, scene in scenes]
    report("recolor, one scribble, all alike", alike, {"covered": "covered", "outside": "outside"})
    report("recolor, hats beside a face", [measure_hat(tint) for tint in HATS], {})
    two = [measure_recolor(scene, i, 2, first + 10 * i, keep=True) for i, scene in scenes]
    report("recolor, two and one to keep", two, {"covered": "covered", "outside": "outside, keep", "border": "border"})
    bright = [measure_brightness(scene, i, first + 10 * i) for i, scene in scenes]
    report("recolor, difference from the painted colour", bright, {})
    report("defocus, one scribble", [measure_defocus(s, 1, first + 10 * i) for i, s in scenes], {"kept": "kept"})
    report("defocus, two", [measure_defocus(s, 2, first + 10 * i) for i, s in scenes], {"kept": "kept, two"})
    size = AREA_SIZE / 16 if chosen.quick else AREA_SIZE
    photographs = [image for _, image in sorted(chosen.images.items())]
    images = (resize(image, viewed_size(image.shape[-2:], size)).clamp(0, 1) for image in photographs)
    smooth = [(image, area) for image in images if (area := smooth_area(image)) is not None]
    report("recolor, smooth areas", [measure_smooth(*s, i, first + i) for i, s in enumerate(smooth)], {})


if __name__ == "__main__":
    main()
