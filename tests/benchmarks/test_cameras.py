"""Simulated cameras: each step is what it claims to be, and the clean picture is the mean of many shots."""

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from benchmarks.photographs import photograph
from benchmarks.training import cameras
from benchmarks.training.cameras import HELD_OUT_PARTS, PARTS, RANGES, Camera
from benchmarks.training.demosaicing import DEMOSAICERS, masks, mosaic
from benchmarks.training.development import expected, inverse_tone_curve, tone_curve
from benchmarks.training.jpeg import compressed, from_luminance, mean_of_rounded, to_luminance
from benchmarks.training.simulated_pairs import as_file, cut, statistics
from benchmarks.training.simulated_pairs import main as compare

SIDE = 48


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def crop(camera: Camera, side: int = SIDE) -> Tensor:
    return cut(photograph("astronaut")[0], camera, side, generator(5))


def flat(*colours: float, side: int = 32) -> Tensor:
    return torch.tensor(colours)[:, None, None].expand(-1, side, side).clone()


@pytest.mark.parametrize("name", DEMOSAICERS)
def test_demosaicers_are_exact_on_flat_colours_and_keep_what_was_measured(name: str) -> None:
    for phase in range(4):
        filters = masks(32, 32, phase)
        assert filters.sum(0).eq(1).all()
        assert filters.mean((1, 2)).tolist() == [0.25, 0.5, 0.25]
        shots = flat(0.2, 0.5, 0.7).expand(2, -1, -1, -1)
        torch.testing.assert_close(DEMOSAICERS[name](mosaic(shots, filters), filters), shots)
        raw = torch.rand(2, 1, 32, 32, generator=generator())
        if name != "median of differences":
            planes = DEMOSAICERS[name](raw, filters)
            torch.testing.assert_close((planes * filters).sum(1, keepdim=True), raw, atol=1e-6, rtol=0)


def test_demosaicers_differ_in_what_they_cost_photographs() -> None:
    picture = photograph("astronaut", 256, 256).expand(2, -1, -1, -1)
    filters = masks(256, 256, 0)
    errors = {
        name: float((run(mosaic(picture, filters), filters) - picture).square().mean().sqrt())
        for name, run in DEMOSAICERS.items()
    }
    assert errors["gradient corrected"] < 0.8 * errors["bilinear"]
    assert errors["directional"] < 0.8 * errors["bilinear"]


@pytest.mark.parametrize(("contrast", "shoulder"), [(0.0, 1.0), (0.9, 0.6), (0.4, 1.1)])
def test_tone_curves_and_their_inverse_cancel(contrast: float, shoulder: float) -> None:
    picture = torch.linspace(0, 1, 1000)
    light = inverse_tone_curve(picture, contrast, shoulder)
    assert (light.diff() > 0).all()
    torch.testing.assert_close(tone_curve(light, contrast, shoulder), picture, atol=0.1 / 255, rtol=0)


def test_a_camera_without_noise_keeps_a_flat_picture_to_rounding() -> None:
    camera = replace(Camera.drawn(generator(3)), exposure=1.0, quality=100.0, second_quality=100.0).without_noise()
    picture = flat(0.4, 0.3, 0.6, side=camera.side_before(SIDE))
    clean, noisy = camera.photograph(picture, SIDE, generator())
    torch.testing.assert_close(clean, picture[:, :SIDE, :SIDE], atol=0.2 / 255, rtol=0)
    torch.testing.assert_close(noisy, clean, atol=0.501 / 255, rtol=0)


def test_the_plainest_camera_changes_nothing_but_what_a_mosaic_loses() -> None:
    camera = Camera()
    picture = crop(camera).mean(0, keepdim=True).expand(3, -1, -1)
    clean, noisy = camera.photograph(picture, SIDE, generator())
    assert (noisy - clean).abs().max() <= 0.501 / 255
    light = camera.seen(picture)
    torch.testing.assert_close(tone_curve(light, 0, 1), picture, atol=0.1 / 255, rtol=0)


def test_colours_go_to_the_sensor_and_back() -> None:
    camera = replace(Camera.drawn(generator(1)), exposure=1.0, lens=0.0)
    picture = crop(camera)
    light = camera.seen(picture)
    assert light.min() >= 0
    gains = torch.tensor([camera.red_gain, 1, camera.blue_gain])[:, None, None]
    developed = torch.einsum("cs,shw->chw", camera.matrix, gains * light)
    torch.testing.assert_close(tone_curve(developed, camera.contrast, camera.shoulder), picture, atol=1e-3, rtol=0)
    torch.testing.assert_close(camera.matrix.sum(1), torch.ones(3))


def test_noise_of_the_sensor_has_the_variance_of_shot_and_read_noise() -> None:
    camera = Camera(shot=4e-3, read_offset=0.5, black=1.0)
    assert math.log(camera.read) == pytest.approx(2.18 * math.log(4e-3) + 1.7)
    for brightness in (0.05, 0.5):
        mean, shot = camera.measured(flat(*[brightness] * 3, side=256), generator(int(100 * brightness)))
        torch.testing.assert_close(mean, torch.full_like(mean, brightness), atol=1e-6, rtol=0)
        assert float(shot.var()) == pytest.approx(4e-3 * brightness + camera.read, rel=0.02)
    rows = replace(camera, row=1.0).measured(flat(0.0, 0.0, 0.0, side=256), generator(1))[1]
    assert float(rows.mean(-1).var()) == pytest.approx(camera.read * (1 + 1 / 256), rel=0.2)


def test_expected_values_are_means_over_the_noise() -> None:
    many = torch.full((1, 1, 300, 300), 0.02) + 0.03 * torch.randn(1, 1, 300, 300, generator=generator())
    shots = torch.cat([torch.full_like(many, 0.02), many])
    mean, actual = expected(lambda values: tone_curve(values, 0, 1), shots, torch.tensor(0.03))
    assert float(mean.mean()) == pytest.approx(float(actual.mean()), abs=0.004)
    assert float(mean.mean()) < float(tone_curve(torch.tensor(0.02), 0, 1)) - 0.01


@pytest.mark.parametrize("deviation", [0.2, 0.5, 2.0])
def test_the_mean_of_rounded_values(deviation: float) -> None:
    values = torch.linspace(-1.5, 1.5, 31)
    noise = deviation * torch.randn(100_000, 1, generator=generator())
    actual = (values + noise).round().mean(0)
    torch.testing.assert_close(mean_of_rounded(values, torch.tensor(deviation)), actual, atol=0.03, rtol=0)


@pytest.mark.parametrize(("quality", "subsampling"), [(75, "4:2:0"), (90, "4:4:4"), (60, "4:2:2")])
def test_compressed_shots_are_those_of_pillow(quality: int, subsampling: str) -> None:
    picture = (255 * photograph("astronaut", 128, 128)[0]).round() / 255
    shots = torch.stack([picture, picture])
    ours = from_luminance(compressed(to_luminance(shots), quality, subsampling))[1].clamp(0, 1)
    with io.BytesIO() as file:
        levels = (255 * picture).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(levels).save(file, "JPEG", quality=quality, subsampling=subsampling)
        theirs = torch.from_numpy(np.array(Image.open(file))).permute(2, 0, 1) / 255
    loss, of_ours, apart = (
        float(255 * (first - second).square().mean().sqrt())
        for first, second in ((theirs, picture), (ours, picture), (ours, theirs))
    )
    assert of_ours == pytest.approx(loss, rel=0.02)
    assert apart < 2.0  # libjpeg works with whole numbers of 8 bits


@pytest.mark.parametrize("seed", range(3))
def test_the_clean_picture_is_the_mean_of_many_shots(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Camera, "_cut", staticmethod(lambda shots, side, _: shots[..., :side, :side]))
    camera = Camera.drawn(generator(seed))
    picture, source = crop(camera, 24), generator()
    shots = [camera.photograph(picture, 24, source) for _ in range(30)]
    clean, noisy = (torch.stack(planes) for planes in zip(*shots, strict=True))
    noise = (noisy - noisy.mean(0)).square().mean()
    bias = (clean.mean(0) - noisy.mean(0)).square().mean() - noise / len(shots)
    assert bias < (0.3**2) * noise


def test_equal_generators_give_equal_cameras_and_photographs_and_leave_the_global_one() -> None:
    state = torch.random.get_rng_state()
    pairs = []
    for seed in (0, 0, 1):
        source = generator(seed)
        camera = Camera.drawn(source)
        pairs.append((camera, torch.stack(camera.photograph(crop(camera), SIDE, source))))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert pairs[0][0] == pairs[1][0] != pairs[2][0]
    assert torch.equal(pairs[0][1], pairs[1][1])


def test_cameras_held_out_have_parameters_that_training_never_draws() -> None:
    for name, limits in RANGES.items():
        for held_out in (False, True):
            for seed in range(40):
                value = limits.drawn(generator(seed), held_out=held_out)
                if value == limits.unused:
                    continue
                assert limits.low <= value <= limits.high, name
                low, high = (math.log(end) if limits.logarithmic else end for end in (limits.low, limits.high))
                place = ((math.log(value) if limits.logarithmic else value) - low) / (high - low)
                assert (int(min(PARTS * place, PARTS - 1)) in HELD_OUT_PARTS) is held_out, name
    names = {
        held: {Camera.drawn(generator(seed), held_out=held).demosaicer for seed in range(20)} for held in (False, True)
    }
    assert names[False] == set(cameras.TRAINED)
    assert names[True] == set(cameras.APART)


def test_photographs_are_pictures_of_eight_bits() -> None:
    for seed in range(4):
        camera = Camera.drawn(generator(seed), held_out=bool(seed % 2))
        clean, noisy = camera.photograph(crop(camera, 33), 33, generator())
        assert clean.shape == noisy.shape == (3, 33, 33)
        for planes in (clean, noisy):
            assert planes.min() >= 0
            assert planes.max() <= 1
        torch.testing.assert_close(255 * noisy, (255 * noisy).round(), atol=1e-4, rtol=0)


def test_a_crop_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"crop must be \(3, 64, 64\) for a side of 48, got \(3, 48, 48\)"):
        Camera().photograph(torch.rand(3, 48, 48), 48, generator())


def test_crops_of_small_pictures_are_mirrored() -> None:
    picture = torch.arange(3.0).view(1, 1, 3).expand(3, 200, 3)
    crop = cut(picture, Camera(), 48, generator())
    assert crop.shape == (3, 64, 64)
    assert crop[0, 0, :9].tolist() == [0, 1, 2, 1, 0, 1, 2, 1, 0]
    assert cut(torch.ones(3, 1, 1), Camera(), 48, generator()).eq(1).all()


def test_statistics_of_white_noise_are_the_same_at_every_scale() -> None:
    clean = torch.rand(3, 1, 1).expand(3, 256, 256) * torch.linspace(0.5, 1, 256)
    values = statistics(clean, clean + 5 / 255 * torch.randn(3, 256, 256, generator=generator()))
    assert values["red"] == pytest.approx(5, rel=0.02)
    assert values["luminance, level"] == pytest.approx(5 / math.sqrt(3), rel=0.02)
    assert values["colour, level"] == pytest.approx(5, rel=0.02)
    for name in ("luminance, 4 over 1", "colour, 4 over 1", "dark over middle"):
        assert values[name] == pytest.approx(1, abs=0.05)
    assert abs(values["red with green"]) < 0.02


def test_the_command_compares_pairs_of_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = photograph("astronaut", 64, 64)[0]
    for name, picture in (("a_mean", clean), ("a_real", (clean + 0.02).clamp(0, 1))):
        levels = (255 * picture).byte().permute(1, 2, 0).numpy()
        Image.fromarray(levels).save(tmp_path / f"{name}.JPG", quality=80)
    written = as_file(clean, tmp_path / "a_real.JPG")
    assert 0 < float((written - clean).abs().mean()) < 0.05
    compare(["--compare", str(tmp_path), "--count", "1"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 20
    assert "inside" in lines[0]
    with pytest.raises(SystemExit, match="must hold pairs"):
        compare(["--compare", str(tmp_path), "--leave-out", "a"])
    with pytest.raises(SystemExit):
        compare(["--compare", str(tmp_path), "--count", "0"])
    assert "--count must be at least 1, got 0" in capsys.readouterr().err
