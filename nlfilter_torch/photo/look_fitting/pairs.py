"""Pairs of photographs before and after an edit, and whether the two of a pair belong together."""

from collections.abc import Iterable, Iterator

from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph, check_same_device, check_same_size
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.look_fitting.alignment import inside_frame
from nlfilter_torch.photo.look_fitting.look_sums import SHADES, means_of_shades

Pair = tuple[Tensor, ...]  # before and after an edit, and masks of regions, if any
ALIKE = 0.5  # least correlation of the luminance of a photograph with that of its edit


def images_of(pairs: Iterable[Pair]) -> Iterator[tuple[Tensor, Tensor, Tensor | None]]:
    """Each image of the pairs, in colour: (3, H, W) before and after the edit, and masks (K, H, W)."""
    number, first = 0, None
    for pair in pairs:
        _check_pair(pair, number, first)
        before, after = pair[:2]
        first = before.new_empty(0) if first is None else first  # on its device, without its pixels
        masks = pair[2] if len(pair) == 3 else None
        names = _names(number)
        for i in range(before.shape[0]):
            image, edited = before[i].expand(3, -1, -1), after[i % after.shape[0]].expand(3, -1, -1)
            check_belong(image, edited, *names)
            yield image, edited, None if masks is None else masks[i % masks.shape[0]]
            number += 1


def _names(number: int) -> tuple[str, str]:
    """Names in errors of the two photographs of a pair."""
    return f"before of pair {number + 1}", f"after of pair {number + 1}"


def _check_pair(pair: Pair, number: int, first: Tensor | None) -> None:
    """Raise unless a pair holds two photographs of the same shape, and masks of their size, if any.

    All of them have to be on the device of the first photograph before the edit, if there was one.
    """
    if not isinstance(pair, tuple | list) or len(pair) not in (2, 3):
        raise TypeError(
            f"pairs must hold tuples of two photographs, or these and masks, got {type(pair).__name__}; "
            "pass [(before, after)]"
        )
    before, after, *masks = pair
    names = _names(number)
    check_photograph(before, names[0])
    if first is not None:
        check_same_device(before, first, names[0], "first pair")
    check_photograph(after, names[1], channels=before.shape[1], batch=before.shape[0])
    check_same_size(after, (before.shape[-2], before.shape[-1]), names[1], names[0], before)
    if before.shape[1] not in (1, 3):
        raise ValueError(f"{names[0]} must have 1 or 3 channels, got {before.shape[1]}; pass grey or RGB")
    for mask in masks:
        if mask is not None:
            check_image(mask, "masks", batch=before.shape[0])
            check_same_size(mask, (before.shape[-2], before.shape[-1]), "masks", names[0], before)


def check_belong(before: Tensor, after: Tensor, first: str, second: str) -> None:
    """Raise unless an image (3, H, W) can be an edit of another one.

    Edits keep most of what is dark and light, or at least (negatives, false colours) most of what luminance says: its
    correlation with the means of the edited luminance of every shade, and the other way round.
    """
    if bool((before == after).all()):
        return  # says that the look leaves it as it is
    shown = inside_frame(before, after) & ((after > 0) & (after < 1)).any(0)
    if not bool(shown.any()):
        raise ValueError(f"{second} must have pixels that are not clipped to black or white, got none; edit it less")
    grey, edited = (reduce_channels(image[None], "luminance")[0, 0, shown].double() for image in (before, after))
    if min(float(grey.std(correction=0)), float(edited.std(correction=0))) < 1 / 255:
        return  # nothing to compare
    shared = float(((means_of_shades(grey, edited) - edited.mean()).square().mean() / edited.var(correction=0)).sqrt())
    if len(grey) >= 4 * SHADES and shared < ALIKE:
        raise ValueError(
            f"{second} must be an edit of {first}, but their brightness agrees only to {100 * shared:.0f} % "
            f"(at least {100 * ALIKE:.0f} % is needed); check that they show the same picture"
        )
