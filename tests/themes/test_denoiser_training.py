"""The denoiser's training: it learns, resumes, and refuses unusable input before it starts."""

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors import safe_open
from torch import Tensor

from benchmarks.denoising.cases import HELD_OUT, LEFT_HALVES
from benchmarks.training import __main__ as command
from benchmarks.training import examples, training
from benchmarks.training.__main__ import main
from benchmarks.training.crops import CONTRASTS, Crops
from benchmarks.training.examples import LARGEST, Examples, Source
from benchmarks.training.graphs import graphed_pivots
from benchmarks.training.pictures import LONGEST, PICTURES, RIGHT_HALVES, Draws, Pictures, read_pictures
from benchmarks.training.training import (
    EXPECTED,
    PlainDenoiser,
    Plan,
    Training,
    errors,
    loss_of,
    rate_at,
    without_rim,
)
from nlfilter_torch import NonlocalDenoiser
from nlfilter_torch.operator import landmarks

ALL, _ = read_pictures(None)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few examples are judged, in small crops."""
    monkeypatch.setattr(training, "ASIDE", 1)
    monkeypatch.setattr(examples, "MARGIN", 4)


def trained(steps: int, seed: int = 0, *, plain: bool = False) -> Training:
    result = Training(Plan(steps, seed=seed, side=16, plain=plain), ALL, ALL)
    result.run()
    return result


@pytest.mark.slow
@pytest.mark.parametrize("plain", [False, True])
def test_loss_falls_and_every_part_learns(plain: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (examples, training):  # of what is trained and of what is judged
        monkeypatch.setattr(module, "SHARES", {"white": 1.0})
    monkeypatch.setattr(training, "ASIDE", 8)
    result = Training(Plan(60, rate=4e-3, side=16, plain=plain), ALL, ALL)
    before = {name: value.detach().clone() for name, value in result.model.named_parameters()}
    result.run()
    judged = result.aside["white, grey"]
    with torch.no_grad():
        at_last = errors(result.denoise(result.model, judged), judged.clean)
    assert at_last.mean() < 0.8 * errors(judged.noisy, judged.clean).mean()
    for name, value in result.model.named_parameters():
        assert not torch.equal(value, before[name]), name


@pytest.mark.usefixtures("small")
def test_equal_seeds_train_equal_weights_and_leave_the_global_generator() -> None:
    state = torch.random.get_rng_state()
    first, again, other = trained(2), trained(2), trained(2, seed=1)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert first.curve[-1]["loss"] == again.curve[-1]["loss"] != other.curve[-1]["loss"]
    assert all(map(torch.equal, first.model.parameters(), again.model.parameters()))


@pytest.mark.usefixtures("small")
def test_a_resumed_training_ends_as_one_that_was_not_stopped() -> None:
    part = trained(2)
    resumed, part.plan = Training(Plan(4, side=16, seed=7), ALL, ALL), Plan(4, side=16)
    resumed.load(copy.deepcopy(part.state()))
    part.run()
    resumed.run()
    assert resumed.number == 4
    assert [row["loss"] for row in resumed.curve[1:]] == [row["loss"] for row in part.curve[1:]]
    assert all(map(torch.equal, part.mean.module.parameters(), resumed.mean.module.parameters()))


@pytest.mark.usefixtures("small")
def test_the_command_writes_weights_and_a_curve_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "SIDE", 16)
    folder = tmp_path / "new"
    main(["--steps", "2", "--scratch", "--out", str(folder)])
    with safe_open(folder / "latest.safetensors", "pt") as file:
        assert file.metadata()["step"] == "2"
    header, *rows = (folder / "curve.csv").read_text().splitlines()
    assert header.startswith('step,seconds,loss,judged,"white, grey"')
    assert [row.split(",")[0] for row in rows] == ["0", "2"]
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "state.pt").stat().st_size < 6_000_000
    first = NonlocalDenoiser.trained(folder / "latest.safetensors")
    NonlocalDenoiser.trained(folder / "denoiser.safetensors")
    capsys.readouterr()
    main(["--steps", "3", "--scratch", "--out", str(folder)])
    assert "resumed at step 2" in capsys.readouterr().out
    second = NonlocalDenoiser.trained(folder / "latest.safetensors")
    assert not torch.equal(first.guide.weight, second.guide.weight)


@pytest.mark.usefixtures("small")
def test_the_best_weights_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = Training(Plan(2, side=16), ALL, ALL)
    values = iter([2.0, 1.0, 3.0])
    monkeypatch.setattr(training, "EVERY", 1)
    monkeypatch.setattr(result, "judge", lambda: {"judged": next(values), "white, grey": 30.0})
    result.run(tmp_path)
    for name, step in (("latest", "2"), ("denoiser", "1")):
        with safe_open(tmp_path / f"{name}.safetensors", "pt") as file:
            assert file.metadata()["step"] == step


def test_a_training_starts_from_the_weights_of_the_package_or_of_a_file() -> None:
    begun = Training(Plan(1, side=16, start=command.TRAINED), ALL, ALL)
    for name, value in NonlocalDenoiser.trained().state_dict().items():
        torch.testing.assert_close(begun.model.state_dict()[name], value, rtol=0, atol=0)


def test_errors_in_the_rim_of_crops_do_not_count() -> None:
    kept = without_rim(torch.arange(32.0 * 32).view(1, 1, 32, 32))
    assert kept.shape == (1, 1, 16, 16)
    assert kept[0, 0, 0, 0] == 8 * 32 + 8


def test_processes_make_the_batches_that_the_training_would_make() -> None:
    plan = Plan(3, side=16, batch=4, parts=2)
    here, apart = (list(Training(replace(plan, workers=workers), ALL, ALL).examples()) for workers in (0, 2))
    assert [batch.clean.shape for batch in here] == [(4, 1, 16, 16), (4, 3, 16, 16), (4, 1, 16, 16)]
    for one, other in zip(here, apart, strict=True):
        assert torch.equal(one.noisy, other.noisy)
        assert torch.equal(one.levels, other.levels)


def test_half_precision_ends_before_the_last_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(
        NonlocalDenoiser,
        "estimate_noise",
        lambda self, noisy, levels: seen.append(torch.is_autocast_enabled("cpu")) or 0,
    )
    result = Training(Plan(10, side=16, half=True), ALL, ALL)
    for result.number in (0, 6, 7, 9):
        result.denoise(result.model, result.aside["clean, grey"])
    assert seen == [True, True, False, False]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_landmarks_are_chosen_by_graphs_on_a_gpu() -> None:
    points = torch.rand(2, 5, 64, generator=torch.Generator().manual_seed(0)).cuda()
    draws = landmarks.cluster_draws(9, 8, torch.Generator().manual_seed(1)).numbers.to(points)
    expected = landmarks.pivots(points, draws, 1e-3)
    with graphed_pivots("cuda"):
        for _ in range(2):
            assert torch.equal(landmarks.pivots(points, draws, 1e-3), expected)


def test_landmarks_are_chosen_as_usual_on_processors() -> None:
    usual = landmarks.pivots
    with graphed_pivots("cpu"):
        assert landmarks.pivots is usual


def test_the_rate_rises_stays_and_falls() -> None:
    rates = [rate_at(step, 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(1 / training.WARM_UP)
    assert max(rates) == 1
    assert rates[training.WARM_UP :] == sorted(rates[training.WARM_UP :], reverse=True)
    assert rates[299] == 1
    assert rates[-1] < 1e-4


def test_the_running_mean_is_over_the_last_steps() -> None:
    mean = [torch.zeros(2)]
    for step in range(2000):
        training.average_late(mean, [torch.full((2,), float(step))], step)
    assert mean[0].tolist() == pytest.approx([2000 * training.LATE / (training.LATE + 1)] * 2, rel=0.01)


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


def ratio(batch: Examples, plane: int) -> Tensor:
    """Actual over told energy of each example, in the luminance or in one colour difference."""
    noise = (batch.noisy - batch.clean).mean(1) if plane == 0 else (batch.noisy - batch.clean)[:, ::2].diff(dim=1)
    return noise.square().mean((1, 2)) / batch.levels[:, plane].square().mean((1, 2))


@pytest.mark.parametrize("grey", [True, False])
@pytest.mark.parametrize("kind", ["white", "camera"])
def test_noise_is_what_the_network_is_told(kind: str, grey: bool) -> None:
    batch = Source(ALL, 64, 5, exact=True).batch(24, grey=grey, kind=kind)
    assert batch.clean.shape == batch.noisy.shape == (24, 1 if grey else 3, 64, 64)
    assert batch.levels.shape == (24, 6, 64, 64)
    assert batch.clean.min() >= -1e-6
    assert batch.clean.max() <= 1 + 1e-6
    assert (batch.levels >= 0).all()
    assert float(ratio(batch, 0).median()) == pytest.approx(1, abs=0.2)
    coarseness = batch.levels[:, 4].mean((1, 2)) / batch.levels[:, 0].mean((1, 2))
    if kind == "white":
        assert batch.levels.square().mean().sqrt() < 2 * LARGEST
        torch.testing.assert_close(coarseness, torch.ones(24))
    else:
        assert coarseness.median() > 1.1


def test_clean_crops_are_said_to_be_almost_clean() -> None:
    batch = Source(ALL, 32, 5).batch(12, grey=False, kind="clean")
    assert torch.equal(batch.clean, batch.noisy)
    assert 0 < batch.levels[:, :2].max() <= 2 / 255
    assert batch.levels.max() < 9 / 255


def test_a_share_of_the_examples_has_misstated_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    def right(misstated: float) -> float:
        monkeypatch.setattr(examples, "MISSTATED", misstated)
        return float(((ratio(Source(ALL, 64, 6).batch(60, grey=True, kind="white"), 0) - 1).abs() < 0.1).float().mean())

    assert right(0.0) > 0.7  # others are clipped
    assert right(1.0) < 0.4


def test_textures_are_up_to_the_given_contrast() -> None:
    crops, grey = Crops(ALL, 32, Draws(7)), torch.full((3, 32, 32), 0.5)
    deviations = [float(crops._add_texture(grey).std()) for _ in range(40)]
    assert 0.1 < max(deviations) <= CONTRASTS[1]


def test_nothing_that_is_judged_is_trained_on() -> None:
    assert set(PICTURES) & set(HELD_OUT) == set(RIGHT_HALVES) == set(LEFT_HALVES)


def test_pictures_of_a_folder_are_reduced_and_some_are_set_aside(tmp_path: Path) -> None:
    for number in range(17):
        size = (2 * LONGEST, 60) if number == 0 else (40, 50)
        Image.new("RGB" if number % 2 else "L", size, number).save(tmp_path / f"{number:02}.png")
    (tmp_path / "notes.txt").write_text("no picture")
    both, aside = read_pictures(tmp_path)
    assert len(both.pictures) == 16 + len(PICTURES)
    assert [int(picture.max()) for picture in aside.pictures] == [15]
    assert both.pictures[0].shape == (1, 30, LONGEST)
    assert float(both.weights[16:].sum() / both.weights.sum()) == pytest.approx(0.15)
    only_small = Pictures(aside.pictures, aside.weights)
    assert only_small.cut(Draws(0), 64).shape == (3, 64, 64)  # smaller than the crop: enlarged
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SystemExit, match=r"--pictures must be a folder of pictures, but .* holds none"):
        read_pictures(empty)


REFUSED = [
    (["--steps", "0"], "--steps must be at least 1, got 0"),
    (["--seed", "-1"], "--seed must not be negative, got -1"),
    (["--rate", "0"], "--rate must be between 0 and 1, got 0"),
    (["--workers", "-1"], "--workers must not be negative, got -1"),
    (["--batch", "6", "--parts", "4"], "--batch must be a multiple of --parts, both at least 1, got 6 and 4"),
    (["--start", "absent"], "--start must be a file of weights, got absent, which is not there"),
    (["--start", "absent", "--scratch"], "not allowed with argument"),
    (["--pictures", "absent"], "--pictures must be a folder, got absent"),
    (["--steps", "many"], "--steps: invalid int value: 'many'"),
]


def test_arguments_are_refused_before_anything_is_trained(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, message in REFUSED:
        monkeypatch.setattr(command, "Training", lambda *_, **__: pytest.fail("trained"))
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
