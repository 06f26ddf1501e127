"""Sliders from a pair of images are recovered despite rounding and clipping, with masks and with other losses."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch import fit_alpha, nonlocal_operator, polynomial_filter
from tests.images import PHOTOGRAPHS, hard_images
from tests.pairwise import each_value
from tests.problems import noise, picture, seeded

ALPHAS = ((2.5, 1.7, 0.6, 1.05), (3.0, 3.0, 4.0, 1.05), (0.2, 0.5, 1.2, 1.0))


def grey(name: str, side: int = 96, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """A photograph in 8 bits with room for edits below and above."""
    return ((255 * (0.5 + 0.5 * (picture(name, side, side) - 0.5))).round() / 255).to(dtype)


def through_png(image: torch.Tensor) -> torch.Tensor:
    """An image (1, 1, H, W) after it was saved as an 8-bit PNG and read again."""
    levels = (image[0, 0].clamp(0, 1) * 255).round().byte().numpy()
    stream = io.BytesIO()
    Image.fromarray(levels).save(stream, format="PNG")
    return torch.from_numpy(np.asarray(Image.open(stream)).copy())[None, None] / 255


@pytest.mark.parametrize(("alpha", "name"), each_value(ALPHAS, PHOTOGRAPHS))
def test_own_output_gives_its_sliders(name: str, alpha: tuple[float, ...]) -> None:
    image = grey(name)
    operator = nonlocal_operator(image, num_landmarks=60)
    wanted = torch.tensor(alpha)
    result = fit_alpha(operator, image, polynomial_filter(operator, image, wanted))
    assert result.shape == (1, 4)
    assert result.dtype == torch.float32
    torch.testing.assert_close(result[0], wanted, atol=1e-4, rtol=0)


@pytest.mark.parametrize("order", [1, 2, 5])
def test_own_output_of_another_order(order: int) -> None:
    image = grey("chelsea")
    operator = nonlocal_operator(image, num_landmarks=60)
    wanted = torch.linspace(2.0, 0.8, order + 1)
    result = fit_alpha(operator, image, polynomial_filter(operator, image, wanted), order=order)
    torch.testing.assert_close(result[0], wanted, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("alpha", "name"), each_value(ALPHAS, PHOTOGRAPHS))
def test_an_8_bit_png_gives_its_sliders_to_5_per_cent(name: str, alpha: tuple[float, ...]) -> None:
    image = grey(name, 192)
    operator = nonlocal_operator(image, photometric_bandwidth=10 / 255)
    wanted = torch.tensor(alpha)
    target = through_png(polynomial_filter(operator, image, wanted))
    torch.testing.assert_close(fit_alpha(operator, image, target)[0], wanted, atol=0, rtol=0.05)


def test_rounding_misleads_plain_least_squares() -> None:
    # Errors below half a level are therefore ignored: on this picture they do not behave like noise.
    image = grey("camera", 192)
    operator = nonlocal_operator(image, photometric_bandwidth=10 / 255)
    wanted = torch.tensor(ALPHAS[0])
    target = through_png(polynomial_filter(operator, image, wanted))
    plain = (fit_alpha(operator, image, target, rounding=0.0)[0] / wanted - 1).abs().max()
    aware = (fit_alpha(operator, image, target)[0] / wanted - 1).abs().max()
    assert aware < 0.1 * plain


def test_clipped_pixels_tell_only_a_bound() -> None:
    image = picture("coins", 192, 192, torch.float32)
    operator = nonlocal_operator(image)
    wanted = torch.tensor([3.0, 3.0, 4.0, 1.05])
    edited = polynomial_filter(operator, image, wanted)
    assert ((edited < 0) | (edited > 1)).float().mean() > 1e-3
    torch.testing.assert_close(fit_alpha(operator, image, through_png(edited))[0], wanted, atol=0, rtol=0.05)


def test_fit_is_the_least_squares_solution() -> None:
    image, target = grey("astronaut", dtype=torch.float64), picture("camera", 96, 96)
    operator = nonlocal_operator(image, num_landmarks=40)
    result = fit_alpha(operator, image, target)

    def error(alpha: torch.Tensor) -> float:
        return float((polynomial_filter(operator, image, alpha) - target).square().mean())

    best = error(result)
    for step in torch.cat([torch.eye(4), -torch.eye(4)]).double():
        assert error(result + 1e-3 * step) > best


def test_batch_is_fitted_image_by_image_or_together() -> None:
    image = torch.cat([grey("astronaut"), grey("chelsea")])
    operator = nonlocal_operator(image, num_landmarks=50)
    alphas = torch.tensor([[2.0, 1.5, 0.7, 1.0], [0.5, 1.2, 1.4, 1.1]])
    target = polynomial_filter(operator, image, alphas)
    torch.testing.assert_close(fit_alpha(operator, image, target), alphas, atol=1e-4, rtol=0)

    same = polynomial_filter(operator, image, alphas[0])
    together = fit_alpha(operator, image, same, shared=True)
    assert together.shape == (1, 4)
    torch.testing.assert_close(together[0], alphas[0], atol=1e-4, rtol=0)
    between = fit_alpha(operator, image, target, shared=True)[0]
    assert not torch.allclose(between, alphas[0], atol=0.05)
    assert not torch.allclose(between, alphas[1], atol=0.05)


def test_colour_images_are_fitted_over_all_channels() -> None:
    image = 0.25 + 0.5 * noise(1, 3, 40, 40, dtype=torch.float32)
    operator = nonlocal_operator(image, num_landmarks=30)
    wanted = torch.tensor([1.5, 0.5, 2.0])
    result = fit_alpha(operator, image, polynomial_filter(operator, image, wanted), order=2)
    torch.testing.assert_close(result[0], wanted, atol=1e-4, rtol=0)


def test_mask_keeps_the_rest_out() -> None:
    image = grey("chelsea")
    operator = nonlocal_operator(image, num_landmarks=50)
    wanted = torch.tensor([2.0, 1.5, 0.7, 1.0])
    mask = torch.zeros(1, 1, 96, 96)
    mask[..., 20:80, 10:70] = 1
    target = torch.where(mask > 0, polynomial_filter(operator, image, wanted), 1 - image)
    torch.testing.assert_close(fit_alpha(operator, image, target, mask=mask)[0], wanted, atol=1e-4, rtol=0)
    assert not torch.allclose(fit_alpha(operator, image, target)[0], wanted, atol=0.1)


def test_ridge_holds_the_sliders_at_one() -> None:
    image = grey("chelsea")
    operator = nonlocal_operator(image, num_landmarks=50)
    target = polynomial_filter(operator, image, torch.tensor([3.0, 3.0, 4.0, 1.05]))
    distance = [
        (fit_alpha(operator, image, target, ridge=r, rounding=rounding) - 1).norm()
        for rounding in (0.0, 0.5 / 255)
        for r in (0.0, 1e-5, 1e-3, 1e3)
    ]
    for free, weak, strong, held in (distance[:4], distance[4:]):
        assert free > weak > strong > held
        assert held < 1e-4


@pytest.mark.parametrize(
    ("name", "dtype"), each_value(["constant", "8x8", "1x64", "two colours"], [torch.float32, torch.float64])
)
def test_what_an_image_does_not_decide_stays_at_one(name: str, dtype: torch.dtype) -> None:
    image = torch.from_numpy(hard_images()[name])[None, None].to(dtype)
    operator = nonlocal_operator(image, num_landmarks=10)
    torch.testing.assert_close(fit_alpha(operator, image, image), torch.ones(1, 4, dtype=dtype), atol=1e-4, rtol=0)
    brighter = fit_alpha(operator, image, 1.1 * image)
    assert brighter.isfinite().all()
    assert (polynomial_filter(operator, image, brighter) - 1.1 * image).abs().max() < 0.06
    if name == "constant":
        torch.testing.assert_close(brighter, torch.tensor([[1, 1, 1, 1.1]], dtype=dtype), atol=1e-4, rtol=0)


def test_another_loss_is_made_small_by_descent() -> None:
    image = grey("chelsea", 64)
    operator = nonlocal_operator(image, num_landmarks=50)
    wanted = torch.tensor([2.0, 1.5, 0.7, 1.0])
    target = polynomial_filter(operator, image, wanted)
    target[torch.rand(target.shape, generator=seeded()) < 0.05] = 1.0  # dust, which misleads least squares
    absolute = fit_alpha(operator, image, target, loss=torch.nn.functional.l1_loss)
    assert (absolute[0] - wanted).abs().max() < 0.02
    assert (fit_alpha(operator, image, target)[0] - wanted).abs().max() > 0.2


def test_descent_on_the_squared_error_is_least_squares() -> None:
    image, other = grey("astronaut", 64, torch.float64), picture("camera", 64, 64)
    operator = nonlocal_operator(image, num_landmarks=40)
    mask = torch.zeros(1, 1, 64, 64, dtype=torch.float64)
    mask[..., 10:50, 5:60] = 1
    exact = fit_alpha(operator, image, other, mask=mask)
    result = fit_alpha(operator, image, other, mask=mask, loss=torch.nn.functional.mse_loss)
    torch.testing.assert_close(result, exact, atol=1e-6, rtol=0)


def test_gradient_reaches_image_target_mask_and_guide() -> None:
    guide, target, mask = noise(1, 1, 9, 8), noise(1, 1, 9, 8, seed=1), 0.1 + noise(1, 1, 9, 8, seed=2)

    def fit(guide: torch.Tensor, image: torch.Tensor, target: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        operator = nonlocal_operator(guide, num_landmarks=6, photometric_bandwidth=0.3)
        return fit_alpha(operator, image, target, order=2, mask=mask)

    tensors = [t.requires_grad_() for t in (guide, noise(1, 1, 9, 8, seed=3), target, mask)]
    assert torch.autograd.gradcheck(fit, tensors, fast_mode=True)


def test_gradient_beyond_the_dead_zone() -> None:
    image, target = noise(1, 1, 9, 8), noise(1, 1, 9, 8, seed=1)
    operator = nonlocal_operator(image, num_landmarks=6, photometric_bandwidth=0.3)
    assert torch.autograd.gradcheck(
        lambda t: fit_alpha(operator, image, t, order=2, rounding=0.05),
        target.requires_grad_(),
        fast_mode=True,
    )


def test_half_precision_and_autocast_change_the_dtype_alone() -> None:
    image = grey("chelsea", 64)
    operator = nonlocal_operator(image, num_landmarks=50)
    target = polynomial_filter(operator, image, torch.tensor([2.0, 1.5, 0.7, 1.0]))
    exact = fit_alpha(operator, image, target)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(fit_alpha(operator, image, target), exact)
    assert fit_alpha(operator, image.half(), target.half()).dtype == torch.float16


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("level", "bandwidth"), [(0.5, "auto"), (-5.0, 1000.0)])
def test_layers_that_are_tiny_multiples_of_others_rest(
    level: float, bandwidth: float | str, dtype: torch.dtype
) -> None:
    """With a constant guide the second layer of any image is a few billionths of its first."""
    operator = nonlocal_operator(
        torch.full((1, 1, 13, 9), level, dtype=dtype), photometric_bandwidth=bandwidth, num_landmarks=40
    )
    image = noise(1, 3, 13, 9, seed=7, dtype=dtype)
    target = polynomial_filter(operator, image, torch.tensor([1.5, 1.2, 0.8, 1.1], dtype=dtype))
    result = fit_alpha(operator, image, target)
    torch.testing.assert_close(result, torch.tensor([[1.5, 1.0, 1.0, 1.1]], dtype=dtype), atol=1e-3, rtol=0)
    assert (polynomial_filter(operator, image, result[0]) - target).abs().max() < 1e-5


def test_pixels_that_do_not_count_and_other_images_change_nothing() -> None:
    images = torch.cat([picture("camera", 24, 32), picture("coffee", 24, 32)])
    operator = nonlocal_operator(images, num_landmarks=20)
    edited = polynomial_filter(operator, images, torch.tensor([1.4, 1.2, 1.0, 1.0]))
    rounded = (edited * 255).round() / 255
    mask = torch.ones(1, 1, 24, 32)
    mask[..., :2] = 0
    other = rounded.clone()
    other[..., :2] += 0.001
    wanted = fit_alpha(operator, images, rounded, mask=mask)
    assert torch.equal(fit_alpha(operator, images, other, mask=mask), wanted)
    mixed = fit_alpha(operator, images, torch.cat([rounded[:1], edited[1:]]))
    torch.testing.assert_close(mixed[:1], fit_alpha(operator, images, rounded)[:1], rtol=0, atol=1e-5)
    torch.testing.assert_close(mixed[1:], fit_alpha(operator, images, edited)[1:], rtol=0, atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")
def test_forward_mode_of_fitted_sliders_is_their_slope() -> None:
    image, tangent = noise(1, 1, 20, 20), noise(1, 1, 20, 20, seed=2)
    operator = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=20)

    def fitted(image: torch.Tensor) -> torch.Tensor:
        return fit_alpha(operator, image, noise(1, 1, 20, 20) ** 1.3, order=2, rounding=0.0)

    step = 1e-6
    slope = (fitted(image + step * tangent) - fitted(image - step * tangent)) / (2 * step)
    torch.testing.assert_close(torch.func.jvp(fitted, (image,), (tangent,))[1], slope, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("bandwidth", "name"), each_value([0.1, 1.0, 100.0], ["spike", "checkerboard", "noise"]))
def test_sliders_of_nearly_proportional_layers_stay_near_the_true_ones(name: str, bandwidth: float) -> None:
    guide = torch.zeros(1, 1, 24, 30).double()
    if name == "spike":
        guide[..., 5, 7] = 1
    else:
        guide[:] = (torch.arange(24)[:, None] + torch.arange(30)) % 2 if name == "checkerboard" else noise(1, 24, 30)
    image = torch.rand(1, 2, 24, 30, generator=seeded(9)).double()
    operator = nonlocal_operator(guide, num_landmarks=10, photometric_bandwidth=bandwidth)
    target = polynomial_filter(operator, image, torch.tensor([3.0, 2.0, 0.5, 1.0]).double())
    result = fit_alpha(operator, image, target)
    assert result.abs().max() < 4
    torch.testing.assert_close(polynomial_filter(operator, image, result), target, atol=1e-9, rtol=0)


def test_only_the_proportions_of_a_mask_count_for_a_loss() -> None:
    image = picture("coffee", 24, 30)
    operator = nonlocal_operator(image, num_landmarks=20)
    target = polynomial_filter(operator, image, torch.tensor([2.0, 1.5, 1.0])).clamp(min=0) ** 1.1
    mask = torch.linspace(0.1, 1, 30).expand(1, 1, 24, 30)
    unscaled, scaled = (
        fit_alpha(operator, image, target, order=2, mask=scale * mask, loss=torch.nn.functional.smooth_l1_loss)
        for scale in (1, 255)
    )
    torch.testing.assert_close(unscaled, scaled, atol=1e-4, rtol=0)
