"""The training example trains, judges what it trained, and refuses what it cannot use before it starts."""

import json

import pytest
import torch
import torch.nn.functional as F

from benchmarks import train_denoiser
from benchmarks.denoising import HELD_OUT, NOISE, Scene, decibels, judge
from benchmarks.train_denoiser import FEATURES, Denoiser, denoise_in_tiles, main, random_crops, train, training_pictures
from tests.problems import seeded

SMALL = ["--side", "32", "--landmarks", "12", "--quick"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder that a short training writes."""
    folder = tmp_path_factory.mktemp("training") / "new"
    main(["--steps", "30", "--out", str(folder), *SMALL])
    return folder


@pytest.mark.slow
def test_table_loss_weights_and_picture_are_written(run):
    figures = json.loads((run / "denoiser.json").read_text())
    rows = figures["psnr"]
    assert {"noisy", "trained", "untrained", "by hand", "scikit-image NLM"} < rows.keys()
    assert any(name.startswith("OpenCV NLM") for name in rows)
    for row in rows.values():
        assert list(row) == [*HELD_OUT, "mean"]
        assert row["mean"] == pytest.approx(sum(row[name] for name in HELD_OUT) / len(HELD_OUT))
    assert rows["noisy"]["mean"] == pytest.approx(decibels(NOISE**2), abs=0.2)
    assert rows["trained"]["mean"] > rows["untrained"]["mean"] + 0.3
    assert (run / "denoiser.png").read_bytes().startswith(b"\x89PNG")
    model = Denoiser(num_landmarks=12, seed=1)
    model.load_state_dict(torch.load(run / "denoiser.pt", weights_only=True))


@pytest.mark.slow
def test_loss_falls_and_every_part_learns(capsys):
    model = Denoiser(num_landmarks=12, seed=0)
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    clean = torch.cat([random_crops(training_pictures(), 32, seeded(seed)) for seed in range(4)])
    noisy = clean + NOISE * torch.randn(clean.shape, generator=seeded(2))
    with torch.no_grad():
        at_first = F.mse_loss(model(noisy), clean)
    losses = train(model, steps=60, side=32, generator=seeded(0))
    with torch.no_grad():
        at_last = F.mse_loss(model(noisy), clean)
    assert at_last < 0.8 * at_first
    assert len(losses) == 60
    assert "step    60 of 60: loss" in capsys.readouterr().out
    assert {f"filter.affinity.log_{name}_bandwidth" for name in ("photometric", "spatial")} < before.keys()
    for name, value in model.named_parameters():
        assert not torch.equal(value, before[name]), name


def test_equal_seeds_train_equal_weights_and_leave_the_global_generator():
    state = torch.random.get_rng_state()
    trained = []
    for seed in (0, 0, 1):
        model = Denoiser(num_landmarks=8, seed=seed)
        losses = train(model, steps=2, side=16, generator=seeded(seed))
        trained.append((losses, [value.detach() for value in model.parameters()]))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert trained[0][0] == trained[1][0] != trained[2][0]
    assert all(map(torch.equal, trained[0][1], trained[1][1]))


def test_the_filter_denoises_and_the_network_cannot_paint():
    """Shares of means of noisy pixels: a constant stays what it is, and nothing leaves the image's range."""
    model = Denoiser(num_landmarks=24 * 24, seed=0)  # all pixels: W as it is, without a negative entry
    noisy = torch.rand(1, 1, 24, 24, generator=seeded(1))
    flat = torch.full_like(noisy, 0.3)
    with torch.no_grad():
        model.last.weight[FEATURES:] *= 100  # sliders that go to their ends
        torch.testing.assert_close(model(flat), flat, rtol=0, atol=1e-4)
        result = model(noisy)
    assert result.min() >= noisy.min() - 1e-4
    assert result.max() <= noisy.max() + 1e-4
    assert (result - noisy).abs().max() > 0.05


@pytest.mark.parametrize("size", [(32, 32), (33, 50), (40, 32)])
def test_tiles_cover_every_pixel_without_a_seam(size):
    noisy = torch.rand(1, 1, *size, generator=seeded(0))
    seen = []

    def identity(tiles):
        seen.append(tiles.shape)
        return tiles

    torch.testing.assert_close(denoise_in_tiles(identity, noisy, 32), noisy)
    assert all(shape[-2:] == (32, 32) for shape in seen)


def test_scores_are_decibels_of_the_squared_error(capsys):
    clean = torch.full((1, 1, 8, 8), 0.5)
    scene = Scene("grey", clean, clean + 0.1)
    table, results = judge({"noisy": lambda noisy: noisy, "half": lambda noisy: noisy - 0.05}, [scene])
    assert table["noisy"] == pytest.approx({"grey": 20.0, "mean": 20.0}, abs=1e-4)
    assert table["half"]["mean"] == pytest.approx(26.0206, abs=1e-3)
    torch.testing.assert_close(results["half"]["grey"], clean + 0.05)
    assert capsys.readouterr().out.splitlines()[1].split() == ["noisy", "20.00", "20.00"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "0"], "--steps must be at least 1, got 0"),
        (["--side", "8"], "--side must be 16 to 96, got 8"),
        (["--side", "128"], "--side must be 16 to 96, got 128"),
        (["--landmarks", "0"], "--landmarks must be 1 to 4096 for this --side, got 0"),
        (["--side", "16", "--landmarks", "257"], "--landmarks must be 1 to 256 for this --side, got 257"),
        (["--seed", "-1"], "--seed must not be negative, got -1"),
        (["--steps", "many"], "--steps: invalid int value: 'many'"),
    ],
)
def test_arguments_are_refused_before_anything_is_trained(arguments, message, capsys, monkeypatch):
    monkeypatch.setattr(train_denoiser, "train", lambda *_: pytest.fail("trained"))
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err


def test_a_file_in_place_of_the_folder_is_refused(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(SystemExit) as stopped:
        main(["--out", str(file)])
    assert stopped.value.code == 2
    assert "--out must be a folder, got the file" in capsys.readouterr().err
    assert file.read_text() == "mine"
