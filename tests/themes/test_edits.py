"""Properties of every edit: dtypes, batches, repetition, gradients and bad input."""

from collections.abc import Callable

import pytest
import torch

from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.photo import (
    abstract,
    adjust_tone,
    colorize,
    defocus,
    denoise,
    enhance,
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


@pytest.mark.parametrize(
    ("edit", "others"),
    [
        (adjust_tone, ()),
        (sharpen, ()),
        (abstract, ()),
        (denoise, ()),
        (enhance, (torch.ones(3),)),
        (region_mask, (SPOT,)),
    ],
)
def test_an_unknown_argument_is_named_with_the_edit(edit: Callable[..., torch.Tensor], others: tuple[object]) -> None:
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


STROKES = {"strokes": paint(1, 0, 0, SPOT), "stroke_mask": SPOT}


@pytest.mark.parametrize(
    ("edit", "image", "arguments", "sentence"),
    [
        (recolor, GREY, STROKES, r"image must have 3 channel\(s\), got 1"),
        (recolor, RGB, {**STROKES, "stroke_mask": 0 * SPOT}, "stroke_mask must hold a painted pixel in every image"),
        (recolor, RGB, {**STROKES, "stroke_mask": 2 * SPOT}, r"stroke_mask must be in \[0, 1\]"),
        (
            recolor,
            RGB,
            {**STROKES, "strokes": torch.ones(1, 3, 9, 9)},
            "strokes must have the height and width of the image",
        ),
        (recolor, RGB, {**STROKES, "keep": torch.ones(1, 1, 9, 9)}, "keep must have the height and width of the image"),
        (recolor, RGB, {**STROKES, "keep": 3 * SPOT}, r"keep must be in \[0, 1\], got values from 0 to 3"),
        (recolor, RGB, {**STROKES, "reach": 1.0}, r"reach must be in \[0, 1\)"),
        (colorize, RGB, STROKES, r"grey must have 1 channel\(s\), got 3; select or convert the channels"),
        (colorize, GREY, {**STROKES, "stroke_mask": 0 * SPOT}, "stroke_mask must hold a painted pixel"),
        (colorize, GREY, {**STROKES, "method": "levin"}, "method must be one of 'regression', 'kmeans', got 'levin'"),
        (colorize, GREY, {**STROKES, "strength": 2.0}, r"strength must be in \[0, 1\]"),
        (
            colorize,
            GREY,
            {**STROKES, "strokes": torch.ones(3, 3, 20, 22)},
            "strokes must have batch size 1 or 2, got 3",
        ),
        (defocus, RGB, {"focus_region": 0 * SPOT}, "focus_region must hold a painted pixel"),
        (
            defocus,
            RGB,
            {"focus_region": SPOT, "background": torch.ones(1, 1, 9, 9)},
            "background must have the height and width of the image",
        ),
        (
            defocus,
            RGB,
            {"focus_region": SPOT, "background": 3 * SPOT},
            r"background must be in \[0, 1\], got values from 0 to 3",
        ),
        (defocus, RGB, {"focus_region": SPOT, "radius": 0.0}, "radius must be positive"),
        (defocus, RGB, {"focus_region": SPOT, "radius": 1e4}, "radius must be at most half the short side of the"),
        (defocus, RGB, {"focus_region": SPOT, "aperture": "square"}, "aperture must be one of 'disc', 'gaussian'"),
        (defocus, RGB[:, :2], {"focus_region": SPOT}, "image must have 1 or 3 channels, got 2"),
        (defocus, RGB, {"focus_region": SPOT[..., :9]}, "focus_region must have the height and width of the image"),
        (abstract, RGB, {"power": -1.0}, r"power must be in \[0, 10\], got -1"),
        (abstract, RGB, {"edges": 2.0}, r"edges must be in \[0, 1\], got 2"),
        (abstract, RGB, {"edge_width": 0.0}, "edge_width must be positive"),
        (abstract, RGB, {"edge_width": 1e4}, "edge_width must be at most half the short side of the"),
        (abstract, RGB, {"tones": 1}, "tones must be at least 2, got 1"),
        (abstract, RGB[:, :2], {"tones": 4}, "image must have 1 or 3 channels for edges and tones, got 2"),
        (denoise, RGB, {"noise_level": -0.1}, "noise_level must be at least 0 and finite"),
        (sharpen, RGB, {"guide_blur": -1.0}, "guide_blur must be at least 0 and finite, got -1"),
        (sharpen, RGB, {"guide_blur": float("inf")}, "guide_blur must be at least 0 and finite, got inf"),
        (adjust_tone, RGB, {"order": 0}, "order must be at least 1, got 0"),
    ],
)
def test_bad_input(edit: Callable[..., torch.Tensor], image: torch.Tensor, arguments: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        edit(image, **arguments)


@pytest.mark.parametrize(
    ("edit", "image", "arguments", "sentence"),
    [
        (enhance, RGB, {"alpha": [1.0, 1.0]}, "alpha must be a torch.Tensor, got list; convert it"),
        (enhance, RGB, {"alpha": torch.ones(2), "regions": [1]}, "regions must be a torch.Tensor, got list"),
        (colorize, GREY, {**STROKES, "strength": None}, "strength must be a number or a tensor, got NoneType"),
        (colorize, GREY, {**STROKES, "photometric_bandwidth": "auto"}, "photometric_bandwidth must be a number or a"),
        (colorize, GREY, {**STROKES, "num_landmarks": "a"}, "num_landmarks must be an int, got str"),
        (abstract, RGB, {"num_landmarks": "a"}, "num_landmarks must be an int, got str"),
        (denoise, RGB, {"num_landmarks": "a"}, "num_landmarks must be an int, got str"),
    ],
)
def test_wrong_types(edit: Callable[..., torch.Tensor], image: torch.Tensor, arguments: dict, sentence: str) -> None:
    with pytest.raises(TypeError, match=sentence):
        edit(image, **arguments)


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
