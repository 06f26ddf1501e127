"""Fixed pairs of cameras held out: the same at every call, and as files."""

from pathlib import Path

import pytest
import torch
from PIL import Image

from benchmarks.photographs import photograph
from benchmarks.training.cameras import Camera
from benchmarks.training.simulated_pairs import main, pairs, read_pairs


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("astronaut", "rocket"):
        levels = (255 * photograph(name, 64, 96)[0]).byte().permute(1, 2, 0).numpy()
        Image.fromarray(levels).save(tmp_path / f"{name}.png")
    return tmp_path


def test_pairs_depend_on_name_camera_and_seed_alone(folder: Path) -> None:
    all_pairs = list(pairs(folder, cameras=2, side=32))
    assert [pair.name for pair in all_pairs] == ["astronaut_0", "astronaut_1", "rocket_0", "rocket_1"]
    (folder / "astronaut.png").unlink()
    for pair, again in zip(all_pairs[2:], pairs(folder, cameras=2, side=32), strict=True):
        assert pair.camera == again.camera
        assert torch.equal(pair.noisy, again.noisy)
        assert torch.equal(pair.clean, again.clean)
    other = next(pairs(folder, side=32, seed=1))
    assert other.camera != all_pairs[2].camera
    assert all(isinstance(pair.camera, Camera) for pair in all_pairs)


def test_the_command_writes_pairs_that_the_comparison_reads(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([str(folder), "--out", str(tmp_path / "pairs"), "--side", "32"])
    assert "2 pairs of 32x32 pixels" in capsys.readouterr().out
    written = read_pairs(tmp_path / "pairs")
    for pair in pairs(folder, side=32):
        clean, noisy = written[pair.name]
        torch.testing.assert_close(noisy, pair.noisy, atol=1e-6, rtol=0)
        torch.testing.assert_close(clean, pair.clean, atol=0.51 / 255, rtol=0)


def test_unusable_arguments_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--out", str(tmp_path), "--side", "0"])
    assert "--side must be at least 1, got 0" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="must hold pictures"):
        main([str(tmp_path), "--out", str(tmp_path)])
