"""Properties of every edit: dtypes, batches, repetition, gradients and bad input."""

from collections.abc import Callable

import pytest
import torch

from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.photo import (
    abstract,
    adjust_light,
    adjust_tone,
    colorize,
    defocus,
    denoise,
    enhance,
    heal,
    recolor,
    region_mask,
    sharpen,
)
from tests.problems import box, colour, noise, paint

GREY = 0.2 + 0.6 * noise(2, 1, 20, 22, dtype=torch.float32)
RGB = 0.2 + 0.6 * noise(2, 3, 20, 22, dtype=torch.float32)
SPOT = box(4, 4, size=(20, 22))
Edit = Callable[[torch.Tensor], torch.Tensor]
EDITS: dict[str, tuple[torch.Tensor, Edit]] = {
    "recolor": (RGB, lambda x: recolor(x, paint(0, 0, 1, SPOT).to(x), SPOT.to(x), num_landmarks=30)),
    "colorize": (GREY, lambda x: colorize(x, paint(0, 0, 0.5, SPOT).to(x), SPOT.to(x), num_landmarks=30)),
    "kmeans": (
        GREY,
        lambda x: colorize(x, paint(0, 0, 0.5, SPOT).to(x), SPOT.to(x), method="kmeans", num_landmarks=30),
    ),
    "adjust_light": (RGB, lambda x: adjust_light(x, SPOT.to(x), exposure=0.5, contrast=0.3, num_landmarks=30)),
    "heal": (RGB, lambda x: heal(x, SPOT.to(x))),
    "defocus": (RGB, lambda x: defocus(x, SPOT.to(x), radius=2.0, num_landmarks=30)),
    "abstract": (RGB, lambda x: abstract(x, tones=6, edges=0.5, num_landmarks=30)),
    "denoise": (RGB, lambda x: denoise(x, noise_level=0.1, num_landmarks=30)),
    "adjust_tone": (RGB, lambda x: adjust_tone(x, contrast=1.2, clarity=2.0, num_landmarks=30)),
    "sharpen": (RGB, lambda x: sharpen(x, amount=3.0, num_landmarks=30)),
    "enhance": (RGB, lambda x: enhance(x, torch.tensor([2.0, 1.5, 1.0]), SPOT.to(x), num_landmarks=30)),
}
each_edit = pytest.mark.parametrize("name", EDITS)


@each_edit
@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_edits_keep_dtype_and_input(name: str, dtype: torch.dtype) -> None:
    image, edit = EDITS[name]
    converted = image.to(dtype)
    before = converted.clone()
    edited = edit(converted)
    assert edited.dtype == dtype
    assert edited.shape == (2, 3, 20, 22)
    assert torch.isfinite(edited).all()
    assert torch.equal(converted, before)


EDITS_OF_IMAGES = [
    (adjust_tone, ()),
    (sharpen, ()),
    (abstract, ()),
    (denoise, ()),
    (enhance, (torch.ones(3),)),
    (region_mask, (SPOT,)),
]


def test_an_unknown_argument_is_named_with_the_edit() -> None:
    for edit, others in EDITS_OF_IMAGES:
        for name in ("contrst", "guide", "source"):
            with pytest.raises(TypeError, match=rf"^{edit.__name__}\(\) got an unexpected keyword argument '{name}'"):
                edit(RGB, *others, **{name: 2})


def test_lazy_negations_are_images_like_others() -> None:
    image = torch.complex(RGB, -RGB).conj().imag
    assert image.is_neg()
    for name in ("recolor", "defocus", "enhance"):
        edit = EDITS[name][1]
        torch.testing.assert_close(edit(image), edit(RGB))


@each_edit
def test_edits_of_a_batch_are_those_of_its_images(name: str) -> None:
    image, edit = EDITS[name]
    image = image.double()
    torch.testing.assert_close(edit(image), torch.cat([edit(image[:1]), edit(image[1:])]), atol=1e-5, rtol=0)


@each_edit
def test_edits_of_a_picture_in_strips_are_those_of_the_whole(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    image, edit = EDITS[name]
    image = image.double()
    wanted, pieces = edit(image), []

    def rows(image: torch.Tensor) -> int:
        pieces.append(image.shape)
        return 7

    monkeypatch.setattr("nlfilter_torch.photo.picture.pixels._rows_at_once", rows)
    torch.testing.assert_close(edit(image), wanted, atol=1e-12, rtol=0)
    assert pieces


@each_edit
def test_edits_are_repeatable_and_leave_the_global_generator_alone(name: str) -> None:
    image, edit = EDITS[name]
    state = torch.get_rng_state()
    assert torch.equal(edit(image), edit(image))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("name", [name for name in EDITS if name != "kmeans"])
def test_edits_have_finite_gradients(name: str) -> None:
    image, edit = EDITS[name]
    converted = image.double().requires_grad_()
    weights = noise(2, 3, 20, 22, seed=3)
    (edit(converted) * weights).sum().backward()
    assert converted.grad is not None
    assert converted.grad.isfinite().all()
    assert converted.grad.abs().max() > 0


@each_edit
def test_edits_refuse_integers_and_other_shapes(name: str) -> None:
    image, edit = EDITS[name]
    with pytest.raises(TypeError, match="must have a floating-point dtype with values in"):
        edit((image * 255).byte())
    with pytest.raises(ValueError, match=r"must have shape \(B, C, H, W\)"):
        edit(image[0])
    with pytest.raises(ValueError, match="must be finite, got"):
        edit(image.clone().fill_(torch.nan))


def test_numbers_do_not_take_the_default_dtype() -> None:
    image = colour("coffee", 30, 40)
    edits = (
        lambda: adjust_tone(image, contrast=1.4, num_landmarks=40),
        lambda: abstract(image, num_landmarks=40),
        lambda: nonlocal_operator(image, num_landmarks=40) @ image,
    )
    expected = [edit() for edit in edits]
    for dtype in (torch.bfloat16, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            edited = [edit() for edit in edits]
        finally:
            torch.set_default_dtype(torch.float32)
        for a, b in zip(edited, expected, strict=True):
            assert torch.equal(a, b)
