"""The GPU benchmark reports when there is no GPU; its computations are tested on the CPU."""

import pytest
import torch

from benchmarks import gpu


def test_without_a_gpu_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu.main([]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_differences_are_those_of_float32() -> None:
    result = gpu.differences("cpu", side=40)
    assert result.pop("segment mask") in (0.0, 1.0)
    for name, difference in result.items():
        assert (
            0 < difference < (0.1 if name in ("region mask", "recolor", "strokes", "gradient by the guide") else 1e-2)
        ), name


def test_differences_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = {"a": torch.zeros(1, 2), "eigenvalues": torch.tensor([[0.9, 0.5]])}
    right = {"a": torch.tensor([[0.0, 0.25]]), "eigenvalues": torch.tensor([[0.9, 0.25, 0.1]])}
    monkeypatch.setattr(gpu, "results", lambda device, *_: right if device == "cpu" else wrong)
    assert gpu.differences("cuda") == {"a": 0.25, "eigenvalues": 0.25}


def test_the_report_has_every_size(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "differences", lambda *_: {"W y": 1e-6})
    gpu.report("cpu", (0.002, 0.004), 64, crop=16)
    printed = capsys.readouterr().out
    assert "| W y | 1.0e-06 |" in printed
    assert "| 0.002 |" in printed
    assert "| 0.004 |" in printed
    assert "training step, 8x3x16x16, m = 48: " in printed


def test_floors_are_the_larger_of_products_and_memory() -> None:
    slow_products, slow_memory = gpu.Rates(1e9, 1e15), gpu.Rates(1e15, 1e9)
    assert gpu.floors(1000, slow_products)[0] == pytest.approx(2e5 * 77 / 1e9)
    assert gpu.floors(1000, slow_memory)[1] == pytest.approx(4 * 4e5 / 1e9)
