"""The trained denoiser: no change without noise, no seams between tiles, precisions, gradients and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.training.training import PlainDenoiser
from nlfilter_torch import NonlocalDenoiser
from nlfilter_torch.core.blocks import EVERYWHERE
from nlfilter_torch.nn.denoiser import network as module
from nlfilter_torch.nn.denoiser import tiles
from nlfilter_torch.nn.denoiser.network import NOISIEST, PIXELS, TRAINED, WIDTH, level_planes
from nlfilter_torch.nn.denoiser.profile import KNOTS, NoiseProfile, join_colours, split_colours, split_noise
from nlfilter_torch.nn.denoiser.tiles import SIDE, STEP, in_tiles
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo import denoise
from nlfilter_torch.photo.edits.denoise import Denoise, NetworkDenoising
from tests.pairwise import each_value
from tests.problems import colour, decibels, noisy, seeded
from tests.rounding import denoiser_rounding

TRAINED_ONE = NonlocalDenoiser.trained()
CAT = colour("chelsea", 96, 128)


@pytest.mark.parametrize(
    ("channels", "level", "gain"),
    [(channels, level, gain) for channels, (level, gain) in each_value([1, 3], [(5, 1.0), (15, 4.0), (50, 8.0)])],
)
def test_photographs_come_closer(channels: int, level: int, gain: float) -> None:
    clean = CAT[:, :channels]
    image = noisy(clean, level / 255)
    with torch.no_grad():
        result = TRAINED_ONE(image, level / 255)
    assert decibels(result, clean) > decibels(image, clean) + gain
    torch.testing.assert_close(denoise(image, noise_level=level / 255), result, rtol=0, atol=1e-6)


def test_it_is_better_than_the_rule() -> None:
    image = noisy(CAT, 25 / 255)
    network, rule = (denoise(image, noise_level=25 / 255, method=method) for method in ("network", "rule"))
    assert decibels(network, CAT) > decibels(rule, CAT) + 1


def test_no_noise_changes_nothing() -> None:
    assert torch.equal(TRAINED_ONE(CAT, 0.0), CAT)
    half = torch.zeros(1, 1, *CAT.shape[-2:])
    half[..., 64:] = 0.1
    result = TRAINED_ONE(CAT, half)
    assert torch.equal(result[..., :64], CAT[..., :64])
    assert not torch.equal(result[..., 64:], CAT[..., 64:])
    assert torch.equal(denoise(CAT, strength=0.0), CAT)


def test_the_level_is_not_rounded_to_the_precision_of_the_image() -> None:
    image = noisy(CAT[..., :64, :64], 0.0123).bfloat16()
    wanted = TRAINED_ONE(image.float(), 0.0123).bfloat16()
    assert torch.equal(TRAINED_ONE(image, 0.0123), wanted)
    assert torch.equal(TRAINED_ONE(image, torch.full((1, 1, 64, 64), 0.0123)), wanted)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 200), (97, 95), (98, 96), (150, 131)])
def test_every_size(size: tuple[int, int]) -> None:
    image = noisy(torch.full((1, 1, *size), 0.5), 0.1)
    with torch.no_grad():
        result = TRAINED_ONE(image, 0.1)
    assert result.shape == image.shape
    assert result.isfinite().all()


@pytest.mark.parametrize("size", [(40, 300), (300, 310)])
def test_tiles_put_together_what_they_took_apart(size: tuple[int, int]) -> None:
    image = torch.rand(2, 3, *size, generator=seeded(0))
    noise = torch.rand(2, 1, *size, generator=seeded(1))
    torch.testing.assert_close(in_tiles(image, noise, lambda x, n: x + n), image + noise, rtol=0, atol=1e-6)


def test_tiles_cover_images_of_every_size() -> None:
    for length in range(1, 600):
        parts = tiles._divided(length)
        assert [tile.start for tile in parts] == [STEP * n for n in range(len(parts))]
        assert parts[-1].stop >= length + 2 * tiles.BORDER
        assert all(tile.stop - tile.start == SIDE for tile in parts[:-1])
        assert parts[-1].stop - parts[-1].start <= SIDE


def test_rows_that_begin_at_a_tile_are_those_of_the_whole() -> None:
    image = noisy(colour("chelsea", 300, 150)[:, :1], 0.1)
    noise = level_planes(0.1, image)
    with torch.no_grad():
        whole = in_tiles(image, noise, TRAINED_ONE.estimate_noise)
        lower = in_tiles(image[..., STEP:, :], noise[..., STEP:, :], TRAINED_ONE.estimate_noise)
    torch.testing.assert_close(lower[..., SIDE:, :], whole[..., STEP + SIDE :, :], rtol=0, atol=denoiser_rounding(0.1))


@pytest.mark.parametrize("inner", [(slice(80, 200), slice(None)), (slice(None), slice(30, 31)), (slice(299, 300),) * 2])
def test_only_the_tiles_of_a_part_are_computed(inner: tuple[slice, slice]) -> None:
    image = noisy(colour("chelsea", 300, 300)[:, :1], 0.1)
    noise, computed = level_planes(0.1, image), []

    def watched(tiles: torch.Tensor, levels: torch.Tensor) -> torch.Tensor:
        computed.append(len(tiles))
        return TRAINED_ONE.estimate_noise(tiles, levels)

    with torch.no_grad():
        whole = in_tiles(image, noise, watched)
        count = sum(computed)
        computed.clear()
        part = in_tiles(image, noise, watched, inner)
    torch.testing.assert_close(part[..., *inner], whole[..., *inner], rtol=0, atol=denoiser_rounding(0.1))
    assert part.isfinite().all()
    assert sum(computed) < 0.8 * count


def test_colours_are_split_and_joined() -> None:
    image = torch.rand(2, 3, 4, 6, generator=seeded(0)).double()
    noise = split_noise(torch.full((2, 1, 4, 6), 0.3).double(), 3)
    torch.testing.assert_close(join_colours(split_colours(image), 3), image)
    torch.testing.assert_close(noise[0, :, 0, 0], torch.tensor([0.3 / 3**0.5, 0.3]).double())
    sample = 0.3 * torch.randn(1, 3, 300, 300, generator=seeded(1)).double()
    spread = split_colours(sample).std((0, 2, 3))
    torch.testing.assert_close(spread, torch.tensor([0.3 / 3**0.5, 0.3, 0.3]).double(), rtol=0.02, atol=0)


def test_images_of_a_batch_are_denoised_as_alone() -> None:
    images = torch.cat([noisy(CAT, 0.1), noisy(colour("coffee", 96, 128), 0.05)])
    levels = torch.tensor([0.1, 0.05])
    with torch.no_grad():
        both = TRAINED_ONE(images, levels)
        for i in range(2):
            alone = TRAINED_ONE(images[i : i + 1], levels[i])
            # Rounding may assign a pixel to another landmark.
            torch.testing.assert_close(both[i : i + 1], alone, rtol=0, atol=1e-3)
            torch.testing.assert_close(TRAINED_ONE(images[i], levels[i].view(1, 1, 1).expand(1, 96, 128)), alone[0])


def test_turns_are_averaged_and_better() -> None:
    image = noisy(CAT, 0.1)
    with torch.no_grad():
        result = {turns: TRAINED_ONE(image, 0.1, turns=turns) for turns in (1, 2, 4)}
        half = TRAINED_ONE(image.rot90(2, (2, 3)), 0.1).rot90(2, (2, 3))
    scores = [decibels(result[turns], CAT) for turns in (1, 2, 4)]
    assert scores == sorted(scores)
    assert decibels((result[1] + half) / 2, CAT) == pytest.approx(scores[1], abs=0.1)  # the tiles differ
    with pytest.raises(ValueError, match="turns must be 1, 2 or 4, got 3"):
        TRAINED_ONE(image, 0.1, turns=3)


def test_numbers_and_maps_of_the_noise_agree() -> None:
    image = noisy(CAT, 0.1)
    maps = (torch.full((1, channels, 96, 128), 0.1) for channels in (1, 3))
    with torch.no_grad():
        wanted = TRAINED_ONE(image, 0.1)
        for noise in (torch.tensor(0.1), torch.tensor([0.1]), *maps):
            torch.testing.assert_close(TRAINED_ONE(image, noise), wanted, rtol=0, atol=1e-5)


def coarse_profile(level: float, *, light: bool = False) -> NoiseProfile:
    """Noise that grows with the scale, and with brightness."""
    growth = torch.tensor([1.0, 1.7, 2.6, 3.0, 3.2]).view(1, -1, 1, 1)
    rise = torch.linspace(0.5, 1.5, KNOTS) if light else torch.ones(KNOTS)
    return NoiseProfile(level * growth * rise * torch.tensor([3**-0.5, 1.0]).view(1, 1, -1, 1), torch.tensor([0.5]))


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_a_profile_of_white_noise_is_its_level(channels: int) -> None:
    image = noisy(CAT[:, :1].repeat(1, channels, 1, 1), 0.1)[..., :64, :64]
    profile = NoiseProfile.white(torch.tensor([0.1]), channels=channels)
    torch.testing.assert_close(level_planes(profile, image), level_planes(0.1, image))
    with torch.no_grad():
        torch.testing.assert_close(TRAINED_ONE(image, profile), TRAINED_ONE(image, 0.1), rtol=0, atol=1e-4)


def test_levels_are_told_by_scale_and_brightness() -> None:
    image = CAT[..., :40, :48]
    levels = level_planes(coarse_profile(0.1, light=True), image)
    assert levels.shape == (1, 6, 40, 48)
    torch.testing.assert_close(levels[:, 2] / levels[:, 0], torch.full((1, 40, 48), 1.7))
    torch.testing.assert_close(levels[:, 5] / levels[:, 1], torch.full((1, 40, 48), 2.6))
    dark, light = (level_planes(coarse_profile(0.1, light=True), torch.full_like(image, x))[0, 1, 5, 5] for x in (0, 1))
    assert (float(dark), float(light)) == pytest.approx((0.05, 0.15))
    grey = level_planes(coarse_profile(0.1), image.expand(2, -1, -1, -1)[:, :2])
    assert grey.shape == (4, 6, 40, 48)
    assert grey[:, 1::2].abs().max() == 0


def test_levels_above_those_of_training_keep_their_ratios() -> None:
    image = CAT[..., :64, :64]
    with torch.no_grad():
        strong, stronger = (TRAINED_ONE(image, coarse_profile(factor * NOISIEST)) for factor in (1.0, 3.0))
    torch.testing.assert_close(strong, stronger, rtol=0, atol=1e-3)


def test_the_edit_takes_profiles_with_a_strength_for_each_image() -> None:
    images, profile = torch.cat([noisy(CAT, 0.1), CAT])[..., :64, :64], coarse_profile(0.1)
    edit = Denoise(noise_level=None, strength=torch.tensor([1.0, 0.5]), method="network", options=FilterOptions())
    result = NetworkDenoising(edit, profile).finish(images, images[:, :1], EVERYWHERE)
    with torch.no_grad():
        for number, strength in enumerate((1.0, 0.5)):
            wanted = TRAINED_ONE(images[number], profile.scaled(strength))
            torch.testing.assert_close(result[number], wanted, rtol=0, atol=1e-3)
    weak = NetworkDenoising(replace(edit, strength=1.0), profile.scaled(1e-3))
    assert torch.equal(weak.finish(images, images[:, :1], EVERYWHERE), images)


@pytest.mark.parametrize("channels", [2, 4])
def test_other_channels_are_denoised_one_by_one(channels: int) -> None:
    image = noisy(CAT[:, :1, 8:].repeat(2, channels, 1, 1), 0.1)
    with torch.no_grad():
        result = TRAINED_ONE(image, 0.1)
        torch.testing.assert_close(result[1:, 1:2], TRAINED_ONE(image[1:, 1:2], 0.1), rtol=0, atol=1e-4)


def test_bright_pictures_are_denoised_as_their_scaled_selves() -> None:
    image = noisy(CAT[..., :64, :64], 0.1)  # a single tile
    image = 2 * image / image.max()
    with torch.no_grad():
        torch.testing.assert_close(
            TRAINED_ONE(4 * image, 0.4), 4 * TRAINED_ONE(image, 0.1), rtol=0, atol=1e-3
        )  # the largest magnitude that the network sees is 2


def test_levels_far_above_those_of_training_leave_the_contrast() -> None:
    image = CAT[..., :64, :64]
    with torch.no_grad():
        result = [TRAINED_ONE(image, level / 255) for level in (100, 255)]
    torch.testing.assert_close(*result, rtol=0, atol=1e-3)  # up to rounding
    assert result[1].mean() > 0.9 * image.mean()
    assert (result[1] - image).square().mean().sqrt() < 30 / 255


def test_gradients_reach_everything() -> None:
    model = NonlocalDenoiser.trained()
    image = noisy(CAT[..., :32, :32], 0.1).requires_grad_()
    noise = torch.full((1,), 0.1, requires_grad=True)
    (model(image, noise) - CAT[..., :32, :32]).square().mean().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name
    assert image.grad is not None
    assert image.grad.isfinite().all()
    assert noise.grad is not None
    assert noise.grad.abs() > 0


def test_gradients_of_float64_are_those_of_differences() -> None:
    model = NonlocalDenoiser.trained().double()
    image = noisy(CAT[:, :1, :16, :16], 0.1).double()
    weights = torch.randn(image.shape, generator=seeded(3)).double()
    direction = torch.randn(image.shape, generator=seeded(4)).double()
    point = image.clone().requires_grad_()
    (weights * model(point, 0.1)).sum().backward()
    assert point.grad is not None
    step = 1e-8  # small, since a pixel near the border of two clusters may change to the other
    with torch.no_grad():
        ends = [(weights * model(image + sign * step * direction, 0.1)).sum() for sign in (1, -1)]
    assert float((point.grad * direction).sum()) == pytest.approx(float(ends[0] - ends[1]) / (2 * step), rel=1e-5)


def test_autocast_rounds_neither_guide_nor_filter() -> None:
    features, planes = torch.randn(1, WIDTH, 24, 32, generator=seeded(5)), noisy(CAT[..., :24, :32], 0.1)
    with torch.no_grad():
        wanted = TRAINED_ONE.smooth(features, planes, PIXELS)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(TRAINED_ONE.smooth(features, planes, PIXELS), wanted)


def test_precisions() -> None:
    image = noisy(CAT, 0.1)
    with torch.no_grad():
        wanted = TRAINED_ONE(image, 0.1)
        half = TRAINED_ONE(image.bfloat16(), 0.1)
        with torch.autocast("cpu", torch.bfloat16):
            cast = TRAINED_ONE(image, 0.1)
    assert half.dtype == torch.bfloat16
    assert cast.dtype == torch.float32
    assert (cast - wanted).abs().mean() < 0.005
    assert decibels(cast, CAT) == pytest.approx(decibels(wanted, CAT), abs=0.1)
    double = denoise(image.double(), noise_level=0.1)
    assert double.dtype == torch.float64
    # Rounding may assign a pixel to another landmark.
    assert (double - denoise(image, noise_level=0.1)).abs().mean() < 1e-3


def test_the_edit_refuses_what_it_cannot_take() -> None:
    with pytest.raises(
        ValueError, match=r"noise_level must be a number or have shape \(B,\) for method rule, got a map"
    ):
        denoise(CAT, noise_level=torch.zeros_like(CAT), method="rule")
    with pytest.raises(ValueError, match="method must be one of 'network', 'rule', got 'luck'"):
        denoise(CAT, method="luck")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"denoise\(\) got an unexpected keyword argument .landmark."):
        denoise(CAT, landmark=3)


@pytest.mark.parametrize("channels", [1, 3])
def test_gradient_by_the_noise_where_it_is_zero(channels: int) -> None:
    network = NonlocalDenoiser.trained(dtype=torch.float64)
    image = colour("chelsea")[:, :channels, :16, :16].double()
    direction = torch.ones(1, 1, 16, 16, dtype=torch.float64)
    level = torch.zeros(1, 1, 16, 16, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(network(image, level).sum(), level)
    step = 1e-7
    change = (network(image, step * direction) - network(image, 0 * direction)).sum() / step
    torch.testing.assert_close((slope * direction).sum(), change.detach(), rtol=1e-3, atol=1e-3)


def test_half_precision_has_a_finite_gradient_by_the_noise() -> None:
    network, image = NonlocalDenoiser.trained().bfloat16(), colour("chelsea")[..., :32, :32].bfloat16()
    level = torch.full((1, 1, 32, 32), 0.1, dtype=torch.bfloat16)
    level[..., :5] = 0
    network(image, level.requires_grad_()).sum().backward()
    assert level.grad is not None
    assert level.grad.isfinite().all()


def test_compiled() -> None:
    torch.compiler.reset()
    image = noisy(CAT[..., :20, :24], 0.1)
    with torch.no_grad():
        result = torch.compile(TRAINED_ONE, backend="eager")(image, 0.1)
        torch.testing.assert_close(result, TRAINED_ONE(image, 0.1), atol=1e-5, rtol=0)


def test_transforms_are_refused() -> None:
    with pytest.raises(TypeError, match=r"noisy must not be transformed by torch\.func"):
        torch.vmap(lambda image: TRAINED_ONE(image, 0.1))(noisy(CAT, 0.1)[None])


@pytest.mark.parametrize("turns", [2.0, True])
def test_turns_are_whole_numbers(turns: object) -> None:
    with pytest.raises(TypeError, match="turns must be an int"):
        TRAINED_ONE(noisy(CAT, 0.1), 0.1, turns=turns)


def test_the_file_of_the_package_is_small_and_says_how_it_was_trained() -> None:
    from safetensors import safe_open
    from safetensors.torch import load_file

    assert TRAINED.stat().st_size < 1_000_000
    weights = load_file(TRAINED)
    assert sum(value.numel() for value in weights.values()) <= 150_000
    for name, value in TRAINED_ONE.state_dict().items():
        assert torch.equal(value, weights[name])
    with safe_open(TRAINED, "pt") as file:
        assert {"steps", "seed", "side", "rate", "loss"} <= file.metadata().keys()


def test_files_that_are_damaged_or_of_something_else_name_themselves(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "weights.safetensors"
    with pytest.raises(FileNotFoundError, match=r"weights\.safetensors cannot be read: No such file"):
        NonlocalDenoiser.trained(path)
    whole = TRAINED.read_bytes()
    for damaged in (b"", whole[:1000], whole[:-4], b"\0" * 100, b"\xff" * 100, b"\2\0\0\0\0\0\0\0[]"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"weights\.safetensors is damaged"):
            NonlocalDenoiser.trained(path)
    save_file(PlainDenoiser().state_dict(), path)
    with pytest.raises(
        ValueError, match=r"must hold log_bandwidths of shape \(2,\), but .*weights.safetensors has none"
    ):
        NonlocalDenoiser.trained(path)
    for dtype, called in ((torch.float16, "float16"), (torch.bfloat16, "'BF16'")):
        save_file({name: value.to(dtype) for name, value in TRAINED_ONE.state_dict().items()}, path)
        with pytest.raises(ValueError, match=f"must be numbers of float32, but .* has {called}; convert them"):
            NonlocalDenoiser.trained(path)


def test_a_second_pass_repeats_the_first_until_it_is_trained(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    once = NonlocalDenoiser(passes=1)
    save_file(once.state_dict(), tmp_path / "once.safetensors")
    twice = NonlocalDenoiser.trained(tmp_path / "once.safetensors")
    assert twice.passes == 2
    image = CAT[..., :40, :40]
    with torch.no_grad():
        assert torch.equal(once(image, 0.1), twice(image, 0.1))
        assert not torch.equal(TRAINED_ONE(image, 0.1), once(image, 0.1))


def test_a_second_pass_is_trained_with_the_first() -> None:
    denoiser = NonlocalDenoiser()
    denoiser(CAT[..., :24, :24], 0.1).square().mean().backward()
    assert denoiser.again.weight.grad is not None
    assert denoiser.again.weight.grad.abs().max() > 0


def test_where_the_second_pass_diverges_the_first_result_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """With features that are too large, as regular stripes beside an even area may have."""
    denoiser = NonlocalDenoiser()
    denoiser.load_state_dict(TRAINED_ONE.state_dict())
    clean = CAT[..., :64, :64]
    image = noisy(clean, 4 / 255)
    with torch.no_grad():
        for further in (60.0, 140.0):
            denoiser.again.bias += further
            assert decibels(denoiser(image, 4 / 255), clean) > decibels(image, clean) + 1
        monkeypatch.setattr(module, "LARGEST", 1e6)
        assert decibels(denoiser(image, 4 / 255), clean) < 20


def test_every_weight_that_learns_gets_a_gradient() -> None:
    """Without a gradient for one of them, DistributedDataParallel stops at the second step."""
    for passes in (1, 2):
        denoiser = NonlocalDenoiser(passes)
        denoiser(torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0)), 0.1).square().mean().backward()
        assert all(w.grad is not None for w in denoiser.parameters() if w.requires_grad)
        assert denoiser.again.weight.requires_grad == (passes > 1)


def test_passes_are_counted() -> None:
    with pytest.raises(ValueError, match="passes must be at least 1, got 0"):
        NonlocalDenoiser(passes=0)


def test_weights_of_ones_own_are_loaded(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    model = NonlocalDenoiser()
    save_file(model.state_dict(), tmp_path / "own.safetensors", {"steps": "0"})
    loaded = NonlocalDenoiser.trained(tmp_path / "own.safetensors")
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)
    header = json.loads((tmp_path / "own.safetensors").read_bytes()[8:].split(b"}}", 1)[0] + b"}}")
    assert header["__metadata__"] == {"steps": "0"}


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_weights_in_half_precision_denoise_colours(dtype: torch.dtype) -> None:
    noisy = 0.5 + 0.1 * torch.randn(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        result = NonlocalDenoiser.trained(dtype=dtype)(noisy, 0.1)
    assert (result - 0.5).std() < 0.04


def test_an_empty_batch_stays_empty() -> None:
    assert TRAINED_ONE(CAT[:0], 0.1).shape == CAT[:0].shape
    with pytest.raises(ValueError, match="noisy must hold at least one pixel"):
        TRAINED_ONE(CAT[:, :, :0], 0.1)
