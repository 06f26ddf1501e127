"""Applying a step to an image, and caching what later steps of the same kind can reuse."""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_photograph
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.shared_parameters import FILTER
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.abstract import abstract
from nlfilter_torch.photo.edits.colorize import colorize
from nlfilter_torch.photo.edits.defocus import defocus
from nlfilter_torch.photo.edits.denoise import denoise
from nlfilter_torch.photo.edits.detail import enhance
from nlfilter_torch.photo.edits.look import apply_look
from nlfilter_torch.photo.edits.recolor import recolor
from nlfilter_torch.photo.edits.sharpen import sharpen
from nlfilter_torch.photo.edits.tone import adjust_tone
from nlfilter_torch.photo.picture.in_memory import InMemory, edited
from nlfilter_torch.photo.picture.painting import mask_of, paint
from nlfilter_torch.photo.picture.source import Fitted, Source, seeded
from nlfilter_torch.photo.picture.viewing import viewed_size

#: The function of each edit.
FUNCTIONS: dict[str, Any] = {
    "detail": enhance,
    "sharpen": sharpen,
    "tone": adjust_tone,
    "denoise": denoise,
    "recolor": recolor,
    "colorize": colorize,
    "defocus": defocus,
    "abstract": abstract,
    "look": apply_look,
}


def check_channels(edit: str, channels: int) -> None:
    """Raise if a grey photograph is to be recoloured."""
    if edit == "recolor" and channels < 3:
        raise ValueError("recolor needs a colour photograph, got a grey one; use colorize for grey photographs")


def scribbles_of(
    step: Step,
    size: tuple[int, int],
    colours: Callable[[Sequence[Stroke], tuple[int, int]], tuple[Any, ...]] = paint,
    mask: Callable[..., Any] = mask_of,
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Convert the strokes of a step to the function's arguments after an image (H, W), positional and by keyword.

    ``colours`` and ``mask`` rasterise strokes to colours with their mask, and to a mask; by default to tensors.

    Raises:
        ValueError: if no pixel is under the strokes that mark the objects.
    """

    def seen(planes: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the planes of strokes, one of which is or has their mask."""
        if not any(bool(plane.any()) for plane in planes if plane is not None):
            raise ValueError(
                f"strokes of {step.edit} must cover a pixel of the photograph, got none that do; move them"
            )
        return planes

    def others(word: str, argument: str) -> dict[str, Any]:
        """Return the argument for strokes that need not be there, and that those on objects may cover."""
        strokes = step.painted(word)
        if not strokes:
            return {}
        found = mask(strokes, size, above=step.painted(step.declared.words[0]))
        return {argument: found} if bool(found.any()) else {}

    if step.edit in ("recolor", "colorize"):
        return seen(colours(step.painted("colour"), size)), others("keep", "keep")
    if step.edit == "defocus":
        return seen((mask(step.painted("in"), size),)), others("out", "background")
    if not step.has_region():
        return (), {}
    sliders = {"alpha": torch.tensor(step.sliders_inside)[None], "outside": torch.tensor(step["alpha"])}
    return seen((mask(step.painted("in"), size),)), sliders | others("out", "negative")


def fit_step(
    step: Step,
    source: Source,
    scribbles: tuple[Any, ...],
    named: dict[str, Any],
    *,
    stride: float = 1,
    generator: torch.Generator | None = None,
) -> Fitted:
    """Fit a step to a source, with the given scribbles in place of the step's own; see :func:`scribbles_of`.

    Args:
        step: step of an edit.
        source: the picture; scribbles, also those in ``named``, are in the form that it takes.
        scribbles: positional arguments of the edit after the picture.
        named: further arguments of the edit.
        stride: sampling step of the source relative to the photograph, in pixels along each axis.
        generator: source of randomness; None is that of the command line.
    """
    check_channels(step.edit, source.channels)
    function = FUNCTIONS[step.edit]
    arguments = step.arguments(source.size, viewed_stride(step, source.size, stride)) | named
    if step.edit == "detail":
        scribbles = (torch.as_tensor(arguments.pop("alpha")), *scribbles)
    return function.fit(source, *scribbles, **arguments, generator=generator or seeded())


@full_precision
def apply_to(
    step: Step,
    image: Tensor,
    scribbles: tuple[Tensor, ...],
    named: dict[str, Tensor],
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Apply a step to an image, with the given scribbles in place of the step's own; see :func:`scribbles_of`."""
    check_photograph(image, "image")
    return edited(image, partial(fit_step, step), scribbles, named, generator=generator)


def apply_step(step: Step, image: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
    """Apply a step to an image (B, C, H, W) in [0, 1]; without a generator, with the seed of the command line."""
    return apply_to(step, image, *scribbles_of(step, (image.shape[-2], image.shape[-1])), generator=generator)


def prepare(step: Step, image: Tensor, *, stride: float = 1) -> Callable[[Step], Tensor]:
    """Return a function that applies steps with equal :func:`filter_key` to an image (1, C, H, W) in [0, 1].

    The filter is computed once, for the first of them, and strokes are rasterised once. ``stride`` is the sampling step
    of the image relative to the photograph.
    """
    source = InMemory(image.to(working_dtype(image)), {})
    colours, mask = lru_cache(maxsize=1)(paint), lru_cache(maxsize=2)(mask_of)

    def edit(step: Step) -> Tensor:
        fitted = fit_step(step, source, *scribbles_of(step, source.size, colours, mask), stride=stride)
        return source.all(fitted).to(image.dtype)

    return edit


def viewed_stride(step: Step, size: tuple[int, int], stride: float) -> float:
    """Sampling step of a picture (H, W) relative to the size at which the step counts pixels: its viewing size, if any.

    ``stride`` is the sampling step of the picture relative to the photograph.
    """
    if stride == 1 or "viewing_size" not in step.arguments(size):
        return stride
    photograph = (round(size[0] * stride), round(size[1] * stride))
    return stride * viewed_size(photograph, step["viewing_size"])[0] / photograph[0]


def filter_key(step: Step) -> tuple[object, ...]:
    """Values that the filter of a step depends on; steps of one kind with equal values share it in :func:`prepare`."""
    return tuple(step[p.name] for p in step.declared if p.keyword in FILTER)


def apply_recipe(
    recipe: Recipe,
    image: Tensor,
    report: Callable[[int, int], object] | None = None,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Edit a photograph as ``nlfilter-torch apply`` does.

    Args:
        recipe: the steps to apply.
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        report: called before each step with how many are done, and of how many.
        generator: source of randomness for the landmarks; None draws the same for every step and call.

    Returns:
        (B, C, H, W), with C = 3 if a step added colour; the image itself if no step has an effect. Values may leave
        [0, 1]; between steps they are limited to it, or to the range of the image if that is larger.
        Differentiable in the image.

    Raises:
        ValueError: if a step cannot be applied to such an image.

    Example:
        >>> from nlfilter_torch.photo import Recipe, Step
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> recipe = Recipe((Step("detail", alpha=(3.0, 1.0)), Step("tone"), Step("detail", alpha=(0.5, 1.0))))
        >>> apply_recipe(recipe, image).shape, apply_recipe(Recipe(), image) is image
        (torch.Size([1, 3, 24, 24]), True)
    """
    result, steps = image, recipe.acting
    for done, step in enumerate(steps):
        if report is not None:
            report(done, len(steps))
        result = apply_step(step, image if result is image else _limited(result, image), generator=generator)
    return result


def _limited(result: Tensor, image: Tensor) -> Tensor:
    """Limit the result of a step to [0, 1], or to the range of the image (B, C, H, W) if that is larger."""
    values = image.detach()
    least, most = values.amin((1, 2, 3), keepdim=True), values.amax((1, 2, 3), keepdim=True)
    return result.clamp(least.clamp(max=0), most.clamp(min=1))
