"""The denoiser's training: it learns, resumes, and refuses unusable input before it starts."""

import copy
import json
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from benchmarks import train_denoiser
from benchmarks.denoiser_crops import LARGEST, PICTURES, RIGHT_HALVES, Crops
from benchmarks.denoising.cases import HELD_OUT, LEFT_HALVES
from benchmarks.train_denoiser import EXPECTED, PlainDenoiser, Training, errors, loss_of, main, rate_at
from nlfilter_torch import NonlocalDenoiser


def trained(steps: int, seed: int = 0, **options: bool) -> Training:
    training = Training(seed, side=16, **options)
    training.run(steps)
    return training


@pytest.mark.slow
@pytest.mark.parametrize("plain", [False, True])
def test_loss_falls_and_every_part_learns(plain: bool) -> None:
    training = Training(0, side=16, plain=plain)
    before = {name: value.detach().clone() for name, value in training.model.named_parameters()}
    training.run(100)
    assert len(training.losses) == 100
    clean, noisy, told = training.aside[0]
    with torch.no_grad():
        at_last = errors(training.denoise(training.model, noisy, told), clean)
    assert at_last.mean() < 0.8 * errors(noisy, clean).mean()
    for name, value in training.model.named_parameters():
        assert not torch.equal(value, before[name]), name


def test_equal_seeds_train_equal_weights_and_leave_the_global_generator() -> None:
    state = torch.random.get_rng_state()
    first, again, other = trained(2), trained(2), trained(2, seed=1)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert first.losses == again.losses != other.losses
    assert all(map(torch.equal, first.model.parameters(), again.model.parameters()))


def test_a_training_that_is_taken_up_ends_as_one_that_was_not_stopped() -> None:
    whole, part = trained(4), trained(2)
    taken_up = Training(7, side=16)
    taken_up.load(copy.deepcopy(part.state()))
    part.run(4)
    taken_up.run(4)
    for other in (part, taken_up):
        assert other.losses[2:] == pytest.approx(whole.losses[2:], rel=0.3)  # the rate depends on the number of steps
    assert taken_up.losses == part.losses
    assert all(map(torch.equal, part.mean.module.parameters(), taken_up.mean.module.parameters()))


def test_the_command_writes_weights_figures_and_a_curve_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new"
    main(["--steps", "2", "--side", "16", "--out", str(folder)])
    figures = json.loads((folder / "denoiser.json").read_text())
    assert figures["steps"] == 2
    assert figures["weights"] == sum(value.numel() for value in NonlocalDenoiser().parameters())
    assert len(figures["set_aside"]) == 1
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    first = NonlocalDenoiser.trained(folder / "denoiser.safetensors")
    capsys.readouterr()
    main(["--steps", "3", "--side", "16", "--out", str(folder)])
    assert "taken up at step 2" in capsys.readouterr().out
    second = NonlocalDenoiser.trained(folder / "denoiser.safetensors")
    assert not torch.equal(first.guide.weight, second.guide.weight)


@pytest.mark.parametrize("more", [[], ["--plain"]])
def test_a_training_starts_from_weights_of_another(more: list[str], tmp_path: Path) -> None:
    main(["--steps", "2", "--side", "16", "--out", str(tmp_path / "first"), *more])
    start = tmp_path / "first" / "denoiser.safetensors"
    begun = Training(1, side=16, start=start, plain=bool(more))
    for name, value in load_file(start).items():
        torch.testing.assert_close(begun.model.state_dict()[name], value, rtol=0, atol=0)
    main(["--steps", "1", "--side", "20", "--start", str(start), "--out", str(tmp_path), *more])
    figures = json.loads((tmp_path / "denoiser.json").read_text())
    before = figures["start"]
    assert (before["side"], before["steps"], figures["side"]) == ("16", "2", 20)


def test_errors_in_the_rim_of_crops_do_not_count() -> None:
    training = Training(0, side=24, rim=6)
    kept = training.without_rim(torch.arange(576.0).view(1, 1, 24, 24))
    assert kept.shape == (1, 1, 12, 12)
    assert kept[0, 0, 0, 0] == 6 * 24 + 6
    judged = training.judge()
    training.aside = [
        (F.pad(training.without_rim(clean), (6, 6, 6, 6)), noisy, told) for clean, noisy, told in training.aside
    ]
    assert training.judge() == judged


def test_the_second_pass_is_not_trained_with_the_first_alone(tmp_path: Path) -> None:
    main(["--steps", "2", "--side", "16", "--passes", "1", "--out", str(tmp_path)])
    assert json.loads((tmp_path / "denoiser.json").read_text())["passes"] == 1
    weights = load_file(tmp_path / "denoiser.safetensors")
    assert weights["again.weight"].abs().max() == 0
    begun = Training(1, side=16, start=tmp_path / "denoiser.safetensors")
    begun.run(2)
    assert begun.model.again.weight.abs().max() > 0


def test_a_larger_share_of_the_steps_has_a_falling_rate() -> None:
    rates = [rate_at(step, 1000, 0.75) for step in range(1000)]
    assert rates[250] == 1 > rates[252]
    assert rates[-1] < 1e-4


def test_the_rate_rises_stays_and_falls() -> None:
    rates = [rate_at(step, 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(1 / train_denoiser.WARM_UP)
    assert max(rates) == 1
    assert rates[train_denoiser.WARM_UP :] == sorted(rates[train_denoiser.WARM_UP :], reverse=True)
    assert rates[599] == 1
    assert rates[-1] < 1e-4


def test_loss_is_the_mean_error_over_what_the_noise_makes_expect() -> None:
    clean = torch.zeros(2, 1, 4, 4)
    denoised, noisy = (
        torch.tensor(levels).view(2, 1, 1, 1).expand(2, 1, 4, 4) / 255 for levels in ([1.0, 3], [5.0, 19])
    )
    assert errors(denoised, clean).tolist() == pytest.approx([1, 3], rel=1e-3)
    wanted = (1 / 6**EXPECTED + 3 / 20**EXPECTED) / 2
    assert float(loss_of(denoised, clean, noisy)) == pytest.approx(wanted, rel=1e-3)


def test_the_network_without_the_filter_has_as_many_weights_at_least() -> None:
    counts = [sum(value.numel() for value in model().parameters()) for model in (NonlocalDenoiser, PlainDenoiser)]
    assert counts[0] <= counts[1] < 1.2 * counts[0]


@pytest.mark.parametrize("grey", [True, False])
def test_crops_are_pictures_with_the_noise_that_is_told(grey: bool) -> None:
    crops = Crops(32, 5)
    differences, levels = [], []
    for _ in range(20):
        clean, noisy, told = crops.batch(8, grey=grey)
        assert clean.shape == noisy.shape == told.shape == (8, 1 if grey else 3, 32, 32)
        assert clean.min() >= -1e-6
        assert clean.max() <= 1 + 1e-6
        assert (told >= 0).all()
        differences.append((noisy - clean).square().mean())
        levels.append(told.square().mean())
    assert float(torch.stack(differences).mean() / torch.stack(levels).mean()) == pytest.approx(1, abs=0.2)
    assert float(torch.stack(levels).max()) < (2 * LARGEST) ** 2


def test_a_share_of_the_crops_has_a_misstated_noise_level() -> None:
    def ratios(misstated: float) -> Tensor:
        clean, noisy, told = Crops(64, 6, misstated=misstated).batch(60, grey=True)
        return told.square().mean((1, 2, 3)) / (noisy - clean).square().mean((1, 2, 3))

    assert ((ratios(0.0) - 1).abs() < 0.1).float().mean() > 0.75  # others are clipped
    assert ((ratios(1.0) - 1).abs() < 0.1).float().mean() < 0.4


def test_textures_are_up_to_the_given_contrast() -> None:
    weak, strong = Crops(32, 7), Crops(32, 7, contrast=0.5)
    grey = torch.full((3, 32, 32), 0.5)
    deviations = [[float(crops._add_texture(grey).std()) for _ in range(40)] for crops in (weak, strong)]
    assert max(deviations[0]) < 0.25 < max(deviations[1])


def test_nothing_that_is_judged_is_trained_on() -> None:
    assert set(PICTURES) & set(HELD_OUT) == set(RIGHT_HALVES) == set(LEFT_HALVES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "0"], "--steps must be at least 1, got 0"),
        (["--side", "8"], "--side must be 16 to 128, got 8"),
        (["--side", "130"], "--side must be 16 to 128, got 130"),
        (["--seed", "-1"], "--seed must not be negative, got -1"),
        (["--rate", "0"], "--rate must be between 0 and 1, got 0"),
        (["--fall", "0"], "--fall must be above 0 and at most 1, got 0"),
        (["--passes", "0"], "--passes must be at least 1, got 0"),
        (["--textured", "2"], "--textured must be 0 to 1, got 2"),
        (["--misstated", "-1"], "--misstated must be 0 to 1, got -1"),
        (["--contrast", "1"], "--contrast must be 2 to 255, got 1"),
        (["--side", "16", "--rim", "8"], "--rim must be at least 0 and less than half of --side, got 8"),
        (["--start", "absent"], "--start must be a file of weights, got absent, which is not there"),
        (["--steps", "many"], "--steps: invalid int value: 'many'"),
    ],
)
def test_arguments_are_refused_before_anything_is_trained(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_denoiser, "Training", lambda *_, **__: pytest.fail("trained"))
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(SystemExit) as stopped:
        main(["--out", str(file)])
    assert stopped.value.code == 2
    assert "--out must be a folder, got the file" in capsys.readouterr().err
    assert file.read_text() == "mine"
