"""Limits of brightness, and the balance of a picture."""

import pytest
import torch

from nlfilter_torch.photo.picture.limits import Balance
from tests.brightness import EDITS, changed, drawn, saturated
from tests.pairwise import each_value
from tests.problems import colour, luminance


def test_changes_keep_within_their_room_and_small_ones_are_kept() -> None:
    image, change = drawn()
    for edited in (changed(image, change), changed(image, change, brighter=0.0)):
        levels = (255 * edited).round()
        assert not bool(((levels <= 0) & (image > 0)).any())  # no channel clips that did not before
        assert not bool(((levels >= 255) & (image < 1)).any())
        assert edited.min() >= -1e-12
        assert edited.max() <= 1 + 1e-12
    edited = changed(image, change)
    moved = luminance(edited) - luminance(image)
    assert bool((moved * change >= -1e-12).all())
    assert bool((moved.abs() <= change.abs() + 1e-12).all())
    before, after = (x - luminance(x) for x in (image, edited))
    assert bool((torch.linalg.cross(before, after, dim=1).abs() < 1e-7).all())  # hues are kept
    assert bool((after.norm(dim=1) <= before.norm(dim=1) + 1e-6).all())
    middle = torch.full((1, 3, 4, 4), 0.5, dtype=torch.float64)
    torch.testing.assert_close(changed(middle, middle[:, :1] * 0.002), middle + 0.001, atol=2e-6, rtol=0)
    still = torch.zeros_like(change)
    assert torch.equal(changed(image, still), image)
    assert torch.equal(changed(image, still, brighter=0.0), image)
    assert torch.equal(changed(image, change, "none"), image + change)


@pytest.mark.parametrize(("rest", "change"), [((87, 160), -0.055), ((170, 90), 0.05)])
def test_a_channel_near_its_end_causes_no_edge(rest: tuple[int, int], change: float) -> None:
    ends = [5, 4, 3, 2, 1, 0] if change < 0 else [250, 251, 252, 253, 254, 255]
    sky = torch.tensor([[end, *rest] for end in ends]).T.reshape(1, 3, 1, 6) / 255  # a smooth saturated area
    moved = luminance(changed(sky, torch.full((1, 1, 1, 6), change)) - sky).flatten() * 255
    assert moved.abs().min() > 5
    assert moved.diff().abs().max() < 1


@pytest.mark.parametrize("channels", [1, 3])
def test_balance_keeps_mean_brightness_and_chroma(channels: int) -> None:
    image, change = drawn()
    image, change = 0.1 + 0.5 * image[:, :channels], 0.2 * change

    def means(x: torch.Tensor) -> torch.Tensor:
        grey = luminance(x) if channels == 3 else x
        return torch.stack([grey.mean((1, 2, 3)), (x - grey).norm(dim=1).mean((1, 2))])

    alone = means(changed(image, change))
    assert (alone[0] - means(image)[0]).abs().min() > 0.004
    for brighter in (0.0, 0.05):
        edited = means(changed(image, change, brighter=brighter))
        torch.testing.assert_close(edited[0], (1 + brighter) * means(image)[0], atol=2e-6, rtol=0)
        torch.testing.assert_close(edited[1], means(image)[1], atol=2e-6, rtol=0)


def test_saturated_colours_keep_their_chroma_and_muted_ones_their_detail() -> None:
    image, change = saturated()
    before = image - luminance(image)

    def lost(edited: torch.Tensor) -> float:
        return 1 - float((edited - luminance(edited)).norm(dim=1).mean() / before.norm(dim=1).mean())

    assert lost(changed(image, change)) > 0.1
    edited = changed(image, change, brighter=0.0)
    assert abs(lost(edited)) < 0.015
    assert abs((luminance(edited) - luminance(image)).mean()) < 2e-6
    assert bool((torch.linalg.cross(before, edited - luminance(edited), dim=1).abs() < 1e-7).all())  # hues are kept
    free, full = (changed(image, change, brighter=Balance(torch.tensor(r).double())) for r in (0.0, 1.0))
    assert abs(lost(full)) < 1e-6
    torch.testing.assert_close(full[..., 27:], free[..., 27:], atol=0, rtol=0)
    assert torch.equal(changed(image, change), free)
    both = torch.cat([image, 0.3 + 0.1 * image]), torch.cat([change, change])  # the second needs no restraint
    together = changed(*both, brighter=0.0)
    for i in range(2):
        alone = changed(both[0][i : i + 1], both[1][i : i + 1], brighter=0.0)
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("restraint", "rest", "change"),
    [
        (restraint, rest, change)
        for restraint, (rest, change) in each_value([0.3, 0.7, 1.0], [((87, 160), -0.055), ((170, 90), 0.05)])
    ],
)
def test_a_restrained_change_causes_no_edge(rest: tuple[int, int], change: float, restraint: float) -> None:
    ends = [9, 8, 7, 6, 5, 4, 3, 2, 1, 0] if change < 0 else [246, 247, 248, 249, 250, 251, 252, 253, 254, 255]
    sky = torch.tensor([[end, *rest] for end in ends]).T.reshape(1, 3, 1, 10) / 255
    balance = Balance(torch.tensor(restraint))
    moved = luminance(changed(sky, torch.full((1, 1, 1, 10), change), brighter=balance) - sky).flatten() * 255
    assert bool((moved * change >= 0).all())
    assert moved.diff().abs().max() < 1.01  # at most as much as the channel


@pytest.mark.parametrize("name", EDITS)
def test_edits_keep_mean_brightness_and_chroma(name: str) -> None:
    image = colour("astronaut", 60, 80)
    for size in (0.0025, 0):
        edited = EDITS[name](image, viewing_size=size)
        assert (luminance(edited) - luminance(image)).mean().abs() < (1 / 255 if size else 2e-5)
        assert (
            (edited - luminance(edited)).norm(dim=1).mean() / (image - luminance(image)).norm(dim=1).mean() - 1
        ) < 0.02


def test_limits_have_exact_gradients() -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(1, 3, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    change = torch.randn(1, 1, 4, 5, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(changed, (image, change))
    for tensors in (saturated(size=6), (image.detach(), change.detach())):
        inputs = [tensor.clone().requires_grad_() for tensor in tensors]
        assert torch.autograd.gradcheck(lambda x, d: changed(x, d, brighter=0.0), inputs)
    still = torch.zeros(1, 1, 4, 5, dtype=torch.float64, requires_grad=True)
    changed(image.detach(), still).sum().backward()
    assert still.grad is not None
    torch.testing.assert_close(still.grad, torch.full_like(still, 3.0))  # gradients can move sliders away from 1


@pytest.mark.parametrize("name", EDITS)
def test_soft_limits_do_not_clip_and_none_is_the_plain_sum(name: str) -> None:
    image = colour("astronaut", 48, 64)
    soft, hard = (EDITS[name](image, limits=limits) for limits in ("soft", "none"))
    inside = (image > 0.02) & (image < 0.98)
    assert soft[inside].min() > 0
    assert soft[inside].max() < 1
    assert hard.min() < 0
    assert hard.max() > 1
    chroma = [x - luminance(x) for x in (hard, image)]
    torch.testing.assert_close(chroma[0], chroma[1], atol=1e-5, rtol=0)  # the change is the same in all channels
    change = luminance(hard) - luminance(image)
    limited = changed(image, change, brighter=0.0)
    torch.testing.assert_close(limited, soft, atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="limits must be one of 'soft', 'none', got 'hard'"):
        EDITS[name](image, limits="hard")


@pytest.mark.parametrize("channels", [1, 3])
def test_values_above_white_change_as_little_as_asked(channels: int) -> None:
    """As in float files; the tone curve that keeps the mean brightness has no meaning there."""
    image, change = drawn()
    image, change = 4 * image[:, :channels], 1e-4 * change.clamp(-2, 2)
    assert (changed(image, change, brighter=0.0) - image).abs().max() < 0.01
