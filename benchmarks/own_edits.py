"""This program's edits found again: ``python -m benchmarks.own_edits [--pictures FOLDER] [--quick] [--look]``.

Presets of ``detail``, other sliders, ``sharpen``, ``tone`` and chains of two are applied to photographs and written as
PNG (8 bits) and as JPEG of quality 95; ``fit_steps`` finds the steps from the photograph and the file. Columns are
shares of the energy of the change in percent, after clipping: of the file, where it was left out of the fit and after
the found steps; and of the edit itself, before the file was written. Then the largest error of a slider, relative, or
absolute for sliders below 1, and the processor time. "other steps" are those of other edits than the right ones.
``--look`` also fits a look, and prints what it explains of what is left out.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import imagecodecs
import numpy as np
import torch
from torch import Tensor

from benchmarks.photographs import pictures
from nlfilter_torch import FittedLook, fit_look
from nlfilter_torch.photo import PRESETS, FittedSteps, Recipe, Step, apply_recipe, fit_steps

REPORTED_ON = ("hubble_deep_field", "motorcycle", "colorwheel")  # nothing was chosen on them
SLIDERS = {"detail": ("alpha",), "tone": ("contrast", "clarity"), "sharpen": ("amount",)}
STRONG, SOFT = Step("sharpen"), Step("sharpen", amount=2.5)
HIGH, LOW = Step("tone", contrast=1.3), Step("tone", contrast=0.85, clarity=1.5)
CRISP, CLEAR = PRESETS["crisp"].steps[0], PRESETS["clear"].steps[0]
PLAIN = Step("detail", alpha=(1.8, 1.4, 0.7, 1.05), threshold=0.0, limits="none")
EDITS: dict[str, Recipe] = {
    **PRESETS,
    "plain detail": Recipe((PLAIN,)),
    "threshold 10": Recipe((CRISP.changed(threshold=10.0),)),
    "sharpen": Recipe((STRONG,)),
    "sharpen a little": Recipe((SOFT,)),
    "contrast": Recipe((HIGH,)),
    "low contrast, clarity": Recipe((LOW,)),
    "contrast, sharpen": Recipe((HIGH, STRONG)),
    "sharpen, contrast": Recipe((STRONG, HIGH)),
    "clear, sharpen": Recipe((CLEAR, SOFT)),
    "sharpen, clear": Recipe((SOFT, CLEAR)),
    "crisp, low contrast": Recipe((CRISP, LOW)),
    "contrast, texture": Recipe((HIGH, PRESETS["texture"].steps[0])),
}


def png(image: Tensor) -> Tensor:
    """A picture in 8 bits."""
    return (image.clamp(0, 1) * 255).round() / 255


def jpeg(image: Tensor) -> Tensor:
    """A picture (1, 3, H, W) in a JPEG file as this program writes it."""
    rgb = np.ascontiguousarray((image.clamp(0, 1) * 255).round().byte()[0].permute(1, 2, 0).numpy())
    decoded = imagecodecs.jpeg8_decode(imagecodecs.jpeg8_encode(rgb, level=95, subsampling="444"))
    return torch.from_numpy(np.ascontiguousarray(decoded)).permute(2, 0, 1)[None].float() / 255


FORMATS: dict[str, Callable[[Tensor], Tensor]] = {"PNG": png, "JPEG": jpeg}


@dataclass(frozen=True)
class Found:
    """How well steps were found.

    Attributes:
        left_out: share of the change of the file explained where it was left out.
        of_file: after the steps.
        of_edit: share of the edit itself.
        error: largest of a slider; None if the edits are not the right ones.
        look: share explained by a look where it was left out; None if no look was fitted.
        seconds: of the processor.
    """

    left_out: float
    of_file: float
    of_edit: float
    error: float | None
    look: float | None
    seconds: float


def share(before: Tensor, after: Tensor, result: Tensor) -> float:
    """Share of the energy of a change that a result explains."""
    after, result = after.clamp(0, 1), result.clamp(0, 1)
    return 1 - float((after - result).double().square().sum() / (after - before).double().square().sum())


def error_of(steps: FittedSteps, recipe: Recipe) -> float | None:
    """The largest error of a slider; None if the steps are other ones."""
    if [step.edit for step in steps.steps] != [step.edit for step in recipe.steps]:
        return None
    errors = [0.0]
    for step, right in zip(steps.steps, recipe.steps, strict=True):
        for name in SLIDERS[step.edit]:
            values, wanted = (torch.tensor(chosen[name]).flatten() for chosen in (step, right))
            errors.append(float(((values - wanted).abs() / wanted.abs().clamp(min=1)).max()))
    return max(errors)


def find(before: Tensor, recipe: Recipe, file: Callable[[Tensor], Tensor], *, look: bool) -> Found:
    """Find the steps of an edit of a photograph."""
    edited = apply_recipe(recipe, before)
    after = file(edited)
    started = time.process_time()
    steps = fit_steps([(before, after)])
    seconds = time.process_time() - started
    result = steps.apply(before)
    explained = None
    if look:
        fitted = fit_look([(before, after)])
        assert isinstance(fitted, FittedLook)
        explained = fitted.left_out
    return Found(
        steps.left_out, share(before, after, result), share(before, edited, result), error_of(steps, recipe),
        explained, seconds,
    )  # fmt: skip


def report(name: str, cases: list[Found]) -> None:
    """Print a line: means, the worst error, and how many cases reach the aims."""
    means = [100 * statistics.mean(getattr(case, of) for case in cases) for of in ("left_out", "of_file", "of_edit")]
    lowest = 100 * min(case.of_edit for case in cases)
    errors = [case.error for case in cases if case.error is not None]
    worst = f"{100 * max(errors):8.1f}" if errors else f"{'':8}"
    missed = f"{len(cases) - len(errors)} other steps" if len(errors) < len(cases) else ""
    looks = [case.look for case in cases if case.look is not None]
    look = f"{100 * statistics.mean(looks):9.1f}" if looks else ""
    seconds = statistics.mean(case.seconds for case in cases)
    print(
        f"{name:34}" + "".join(f"{v:9.2f}" for v in (*means, lowest)) + f"{worst}{seconds:7.1f}{look} {missed}",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, help="folder of photographs, in place of scikit-image's")
    parser.add_argument("--most", type=int, default=3, help="largest number of photographs")
    parser.add_argument("--side", type=int, default=256, help="pixels of the short side")
    parser.add_argument("--edits", nargs="+", default=list(EDITS), choices=EDITS, metavar="NAME", help="all by default")
    parser.add_argument("--formats", nargs="+", default=list(FORMATS), choices=FORMATS, help="all by default")
    parser.add_argument("--look", action="store_true", help="fit a look as well")
    parser.add_argument("--quick", action="store_true", help="a small photograph, and three edits")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.most, arguments.side, arguments.edits = 1, 64, ["clear", "sharpen", "contrast"]
    images = dict(list(pictures(arguments.pictures, arguments.side, REPORTED_ON).items())[: arguments.most])
    print(
        f"photographs: {', '.join(images)}; left out, file, edit, lowest edit (%), slider error (%), seconds, look (%)"
    )
    for format_name in arguments.formats:
        everything = []
        for name in arguments.edits:
            cases = [
                find(png(image), EDITS[name], FORMATS[format_name], look=arguments.look) for image in images.values()
            ]
            report(f"{format_name} {name}", cases)
            everything += cases
        report(f"{format_name} all", everything)


if __name__ == "__main__":
    main()
