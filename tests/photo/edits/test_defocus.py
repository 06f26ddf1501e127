"""Defocus: the subject stays sharp, the rest is blurred, and neither bleeds into the other."""

import pytest
import torch
import torch.nn.functional as F

from nlfilter_torch.photo import defocus, region_mask
from nlfilter_torch.photo.edits.defocus import ROWS, convolve
from tests.pairwise import each_value
from tests.problems import box, colour


def gradient_energy(image: torch.Tensor, mask: torch.Tensor) -> float:
    rows, columns = image.diff(dim=2)[..., :-1], image.diff(dim=3)[..., :-1, :]
    return float(((rows.square() + columns.square()) * mask[..., :-1, :-1]).sum())


@pytest.mark.parametrize("aperture", ["disc", "gaussian"])
def test_the_subject_stays_sharp_and_the_rest_does_not(aperture: str) -> None:
    image = colour("astronaut", 128, 128)
    region = box(15, 47, 15, 15, size=(128, 128)) + box(70, 15, 30, 8, size=(128, 128))
    blurred = defocus(image, region, radius=4.0, aperture=aperture)
    assert torch.equal(blurred[(region > 0).expand_as(image)], image[(region > 0).expand_as(image)])
    face = box(22, 45, 20, 18, size=(128, 128))
    assert gradient_energy(blurred, face) >= 0.94 * gradient_energy(image, face)  # its corners hold ground
    far = box(0, 95, 60, 33, size=(128, 128))  # the shuttle
    assert gradient_energy(blurred, far) < 0.3 * gradient_energy(image, far)
    assert blurred.min() >= image.min() - 1e-4
    assert blurred.max() <= image.max() + 1e-4


def test_the_subject_does_not_bleed() -> None:
    """A white subject on black leaves no glow, where a plain blur would."""
    image = torch.zeros(1, 1, 60, 60)
    image[..., 20:40, 20:40] = 1
    blurred = defocus(image, box(22, 22, 16, 16, size=(60, 60)), radius=5.0, num_landmarks=40)
    outside = torch.ones(1, 1, 60, 60)
    outside[..., 17:43, 17:43] = 0
    plain = F.avg_pool2d(image, 9, stride=1, padding=4)
    assert blurred[outside > 0].max() < 0.15 * plain[outside > 0].max()


def test_a_dot_may_be_in_focus_and_everything_may() -> None:
    image = colour("astronaut")
    assert torch.equal(defocus(image, torch.ones(1, 1, 64, 64), radius=3.0), image)
    dot = box(40, 10, 1, 1)
    blurred = defocus(image, dot, radius=3.0)
    assert torch.equal(blurred[..., 40, 10], image[..., 40, 10])
    near, far = box(36, 8, 8, 6), box(4, 44, 20, 16)
    assert gradient_energy(blurred, near) / gradient_energy(image, near) > 0.8
    assert gradient_energy(blurred, far) / gradient_energy(image, far) < 0.5


def test_odd_pixels_of_the_subject_do_not_bring_the_background_into_focus() -> None:
    image = colour("astronaut", 128, 128)
    region = box(65, 10, 40, 8, size=(128, 128))
    odd = box(65, 10, 2, 8, size=(128, 128))  # shows the backdrop
    image = torch.where(odd > 0, image[..., 10:11, 85:86], image)
    blurred = defocus(image, region, radius=4.0)
    far = box(0, 95, 60, 33, size=(128, 128))
    assert gradient_energy(blurred, far) < 0.3 * gradient_energy(image, far)


def test_flat_images_stay_flat() -> None:
    flat = torch.full((1, 3, 24, 30), 0.3)
    torch.testing.assert_close(defocus(flat, box(4, 4, size=(24, 30))), flat, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("height", "radius"), each_value([7, ROWS, 3 * ROWS + 11], [1, 4, 24]))
def test_convolution_in_parts_is_that_of_the_whole(height: int, radius: int) -> None:
    generator = torch.Generator().manual_seed(0)
    planes = torch.rand(2, 1, height, 30, generator=generator, dtype=torch.float64)
    kernel = torch.rand(2 * radius + 1, 2 * radius + 1, generator=generator, dtype=torch.float64)
    kernel = kernel + kernel.flip(0, 1)
    wanted = F.conv2d(planes, kernel[None, None], padding=radius)
    torch.testing.assert_close(convolve(planes, kernel), wanted, atol=1e-10, rtol=0)


def test_the_subject_is_that_of_a_mask_of_the_same_scribbles() -> None:
    image, region = colour("chelsea"), box(24, 24)
    for options in ({}, {"reach": 0.2}):
        mask = region_mask(image, region, num_landmarks=20, **options)
        edited = defocus(image, region, num_landmarks=20, **options)
        changed = (edited - image).abs().amax(1, keepdim=True)
        assert changed[mask > 0.8].max() < 1e-3
        assert changed[mask < 0.1].max() > 0.01


def test_background_scribbles_are_blurred_with_what_resembles_them() -> None:
    """Two squares of one colour: the one under a background scribble is blurred, the other stays sharp."""
    image = 0.4 + 0.1 * torch.rand(1, 3, 60, 90, generator=torch.Generator().manual_seed(0))
    subject, twin = box(20, 10, 20, 20, size=(60, 90)), box(20, 60, 20, 20, size=(60, 90))
    image[:, 0] += 0.4 * (subject + twin)[:, 0]
    region, background = box(26, 16, 8, 8, size=(60, 90)), box(26, 66, 8, 8, size=(60, 90))
    inner = box(24, 64, 12, 12, size=(60, 90))
    options = {"radius": 4.0, "spatial_bandwidth": float("inf"), "num_landmarks": 60, "extent": "near"}
    alone = defocus(image, region, **options)
    assert gradient_energy(alone, inner) > 0.9 * gradient_energy(image, inner)
    blurred = defocus(image, region, background=background, **options)
    assert gradient_energy(blurred, inner) < 0.3 * gradient_energy(image, inner)
    own = box(24, 14, 12, 12, size=(60, 90))
    assert gradient_energy(blurred, own) > 0.9 * gradient_energy(image, own)
    none = defocus(image, region, background=torch.zeros_like(region), **options)
    torch.testing.assert_close(none, alone, rtol=0, atol=0)


def test_background_scribbles_under_those_on_the_subject_are_refused() -> None:
    region, background = box(20, 20, 8, 8), box(22, 22, 4, 4)
    with pytest.raises(ValueError, match="background must hold a painted pixel outside the scribbles on the object"):
        defocus(colour("chelsea"), region, background=background, num_landmarks=20)


def test_background_scribbles_have_a_gradient() -> None:
    image = colour("chelsea", 40, 40).double()
    background = 0.5 * box(4, 4, 8, 8).double()[..., :40, :40]
    background.requires_grad_()
    defocus(image, box(20, 20, 8, 8)[..., :40, :40], background=background, num_landmarks=20).square().mean().backward()
    assert background.grad is not None
    assert background.grad.isfinite().all()
    assert background.grad.abs().max() > 0
