"""A filter fitted to one image and applied to others: exact on its own image, equal for equal patches, no flicker."""

from itertools import pairwise

import pytest
import torch

from nlfilter_torch import nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo import filter_frames
from nlfilter_torch.photo.picture.colour import edit_luminance
from tests.films import pan
from tests.problems import noise, picture

ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05], dtype=torch.float64)
PLAIN: dict = {"limits": "none", "threshold": 0.0}  # the filter as it is


def flicker(edited: list[torch.Tensor], step: int) -> float:
    """Return the mean difference of successive frames after alignment."""
    pairs = pairwise(edited)
    return float(torch.stack([(a[..., step:, step:] - b[..., :-step, :-step]).abs().mean() for a, b in pairs]).mean())


@pytest.mark.slow
def test_ten_frames_of_a_pan_do_not_flicker() -> None:
    film, step = pan(10, 7), 7
    assert flicker(film, step) == 0
    alpha = ALPHA.float()
    together = list(filter_frames(film, alpha, references=[film[0], film[5], film[9]]))
    apart_edited = [next(filter_frames([frame], alpha, references=[frame])) for frame in film]
    assert flicker(together, step) <= flicker(apart_edited, step) / 5
    # The edit is the same: frames differ from frames edited alone by less than the edit changes them.
    change = torch.stack([(a - b).abs().mean() for a, b in zip(apart_edited, film, strict=True)]).mean()
    apart = torch.stack([(a - b).abs().mean() for a, b in zip(apart_edited, together, strict=True)]).mean()
    assert apart < change / 3


def test_equal_areas_of_frames_are_edited_equally_whatever_else_they_show() -> None:
    first = picture("coffee", 40, 60).float().expand(-1, 3, -1, -1)
    second = first.clone()
    second[..., 40:] = 1  # brighter, which must not change the brightness of the rest
    edited = list(filter_frames([first, second], ALPHA.float(), references=[first], num_landmarks=40))
    torch.testing.assert_close(edited[0][..., :30], edited[1][..., :30], atol=1e-6, rtol=0)
    assert (edited[0] - first)[..., :30].abs().max() > 0.01


def test_each_frame_has_a_gradient_of_its_own() -> None:
    film = [noise(1, 3, 12, 14, dtype=torch.float32, seed=seed) for seed in range(2)]
    alpha = ALPHA.float().requires_grad_()
    options: dict = {"references": film[:1], "num_landmarks": 20}
    both = (filter_frames(film, sliders, **options) for sliders in (alpha, ALPHA.float()))
    for frame, plain in zip(*both, strict=True):
        torch.testing.assert_close(frame.detach(), plain)
        assert torch.autograd.grad(frame.sum(), alpha)[0].isfinite().all()


def test_one_reference_is_the_usual_filter_on_luminance() -> None:
    frame = pan(1, 1, 40, 50)[0]
    grey = reduce_channels(frame, "luminance")
    operator = nonlocal_operator(grey)
    expected = edit_luminance(frame, lambda planes: polynomial_filter(operator, planes, ALPHA.float()))
    edited = next(filter_frames([frame], ALPHA.float(), references=[frame], **PLAIN))
    torch.testing.assert_close(edited, expected, atol=2e-4, rtol=0)


def test_all_channels_on_request() -> None:
    frame = pan(1, 1, 40, 50)[0]
    operator = nonlocal_operator(reduce_channels(frame, "luminance"), num_landmarks=60)
    wanted = polynomial_filter(operator, frame, ALPHA.float())
    options = {"channels": "all", "num_landmarks": 60} | PLAIN
    edited = next(filter_frames([frame], ALPHA.float(), references=[frame], **options))
    torch.testing.assert_close(edited, wanted, atol=2e-4, rtol=0)
    with pytest.raises(ValueError, match="channels must be one of"):
        filter_frames([frame], ALPHA.float(), references=[frame], channels="red")


def test_frames_are_read_one_at_a_time() -> None:
    film, seen = pan(3, 5, 30, 30), []

    def read() -> object:
        for i, frame in enumerate(film):
            seen.append(i)
            yield frame

    edited = filter_frames(read(), ALPHA.float(), references=film[:1], num_landmarks=30)
    assert seen == []
    next(edited)
    assert seen == [0]
