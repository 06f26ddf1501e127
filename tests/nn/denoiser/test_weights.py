"""The file of the trained denoiser, its passes, and weights of one's own."""

import json
from pathlib import Path

import pytest
import torch

from benchmarks.denoiser_training.training import PlainDenoiser
from nlfilter_torch import NonlocalDenoiser
from nlfilter_torch.nn.denoiser import network as module
from nlfilter_torch.nn.denoiser.network import TRAINED
from tests.problems import colour, decibels, noisy

TRAINED_ONE = NonlocalDenoiser.trained()
CAT = colour("chelsea", 96, 128)


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
    half = {name: value.half() for name, value in TRAINED_ONE.state_dict().items()}
    save_file(half, path)
    with pytest.raises(ValueError, match=r"must be numbers of float32, but .* has torch.float16"):
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
