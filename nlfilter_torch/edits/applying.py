"""What a step does to an image, and what of it can be kept for the next step of its kind."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.edits.abstract import Abstraction, abstract
from nlfilter_torch.edits.colorize import Colorization, colorize
from nlfilter_torch.edits.defocus import Defocusing, defocus
from nlfilter_torch.edits.denoise import denoise
from nlfilter_torch.edits.detail import enhance
from nlfilter_torch.edits.parameters import FILTER
from nlfilter_torch.edits.recolor import Recoloring, recolor
from nlfilter_torch.edits.scribbles import Stroke, mask_of, paint
from nlfilter_torch.edits.sharpen import sharpen
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.edits.tone import adjust_tone
from nlfilter_torch.operator.features import reduce_channels

#: The edits as functions of an image, the scribbles on it and parameters.
FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    "denoise": denoise,
    "detail": enhance,
    "tone": adjust_tone,
    "sharpen": sharpen,
    "colorize": colorize,
    "recolor": recolor,
    "defocus": defocus,
    "abstract": abstract,
}


def seeded(seed: int = 0) -> torch.Generator:
    """The randomness that the command line starts with."""
    return torch.Generator().manual_seed(seed)


def check_channels(edit: str, channels: int) -> None:
    """Raise if a grey photograph is to be recoloured."""
    if edit == "recolor" and channels < 3:
        raise ValueError("recolor needs a colour photograph, got a grey one; use colorize, which colours grey ones")


def scribbles_of(step: Step, size: tuple[int, int]) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
    """The strokes of a step as tensors: those that its function takes after the image, and those it takes by name."""
    if step.edit in ("recolor", "colorize"):
        keep = mask_of(step.painted("keep"), size)
        return paint(step.painted("colour"), size), {"keep": keep} if bool(keep.any()) else {}
    if step.edit == "defocus":
        return (mask_of(step.painted("in"), size),), {}
    if not step.has_region():
        return (), {}
    outer = mask_of(step.painted("out"), size)
    sliders = {"alpha": torch.tensor(step.sliders_inside)[None], "outside": torch.tensor(step["alpha"])}
    negative = {"negative": outer} if bool(outer.any()) else {}
    return (mask_of(step.painted("in"), size),), sliders | negative


def apply_to(
    step: Step,
    image: Tensor,
    scribbles: tuple[Tensor, ...],
    named: dict[str, Tensor],
    *,
    stride: int = 1,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The edited image under scribbles, see :func:`scribbles_of`, in place of those of the step."""
    check_channels(step.edit, image.shape[1])
    arguments = step.arguments((image.shape[-2], image.shape[-1]), stride) | named
    if step.edit == "detail":
        scribbles = (torch.as_tensor(arguments.pop("alpha")), *scribbles)
    if step.edit == "colorize":
        image = reduce_channels(image, "luminance")
    return FUNCTIONS[step.edit](image, *scribbles, **arguments, generator=generator or seeded())


def apply_step(step: Step, image: Tensor, *, stride: int = 1, generator: torch.Generator | None = None) -> Tensor:
    """The edited image, from (1, C, H, W) in [0, 1].

    Args:
        step: of an edit.
        image: (1, C, H, W).
        stride: every how many pixels of the photograph the image has one.
        generator: source of randomness; None is that of the command line.
    """
    painted = scribbles_of(step, (image.shape[-2], image.shape[-1]))
    return apply_to(step, image, *painted, stride=stride, generator=generator)


def prepare(step: Step, image: Tensor, *, stride: int = 1) -> Callable[[Step], Tensor]:
    """What steps that agree in :func:`shared` make of an image; the filter is made once, for the first of them."""
    size = (image.shape[-2], image.shape[-1])
    options = {k: v for k, v in step.arguments(size, stride).items() if k in FILTER} | {"generator": seeded()}
    if step.edit == "recolor" and image.shape[1] == 3:
        cached: Any = Recoloring(image, **options)
    elif step.edit == "colorize":
        cached = Colorization(reduce_channels(image, "luminance"), **options)
    elif step.edit == "abstract":
        cached = Abstraction(image, **options)
    elif step.edit == "defocus":
        blurring = Defocusing(image, **options)
        focused: dict[tuple[Stroke, ...], Tensor] = {}

        def defocused(step: Step) -> Tensor:
            if step.strokes not in focused:
                focused.clear()
                focused[step.strokes] = blurring.focus(*scribbles_of(step, size)[0])
            given = step.arguments(size, stride)
            return blurring.blur(focused[step.strokes], given["radius"], given["aperture"])

        return defocused
    else:
        return lambda step: apply_step(step, image, stride=stride)

    def edit(step: Step) -> Tensor:
        scribbles, named = scribbles_of(step, size)
        own = {k: v for k, v in step.arguments(size, stride).items() if k not in FILTER}
        result: Tensor = cached(*scribbles, **named, **own)
        return result

    return edit


def shared(step: Step) -> tuple[object, ...]:
    """What steps must agree in, beside their kind, to share what :func:`prepare` makes."""
    return tuple(step[p.name] for p in step.declared if p.keyword in FILTER)
