"""Figures with limits, and the pictures that they are measured on."""

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from benchmarks.harness import Figure
from benchmarks.layers import __main__ as program
from benchmarks.layers.styles import StyleNetwork, style
from benchmarks.photographs import HELD_OUT_OF_KODAK, PIECES, held_out, large
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph


@pytest.mark.parametrize(
    ("figure", "holds"),
    [
        (Figure("below", 0.9, 1.0), True),
        (Figure("above", 1.1, 1.0), False),
        (Figure("above", 1.1, 1.0, at_most=False), True),
        (Figure("no limit", 7.0), True),
        (Figure("no limit", math.nan), False),
        (Figure("no limit", math.inf), False),
        (Figure("at least", math.inf, 1.0, at_most=False), False),
    ],
)
def test_a_figure_holds_if_it_is_finite_and_keeps_its_limit(figure: Figure, holds: bool) -> None:
    assert figure.holds is holds
    assert ("FALLS SHORT" in str(figure)) is not holds


@pytest.mark.parametrize(("value", "code"), [(1.0, 0), (3.0, 1), (math.nan, 1)])
def test_the_program_fails_for_a_figure_that_does_not_hold(
    value: float, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def measure(*, quick: bool, kodak: Path | None) -> Iterator[Figure]:
        assert (quick, kodak) == (True, Path("pictures"))
        yield Figure("a figure", value, 2.0)

    monkeypatch.setattr(program.importlib, "import_module", lambda name: SimpleNamespace(measure=measure))
    assert program.main(["functions", "--quick", "--kodak", "pictures"]) == code
    assert ("holds" in capsys.readouterr().out) is (code == 0)


def test_pictures_are_those_of_scikit_image_or_kodak(tmp_path: Path) -> None:
    assert [picture.shape[1] for picture in held_out(None).values()] == [3, 3, 1]
    assert large(None, 60).shape == (1, 3, 60, 60)
    for number in {*HELD_OUT_OF_KODAK, *PIECES}:
        picture = torch.full((1, 3, 60, 90), number / 255)
        write_photograph(Photograph(picture), tmp_path / f"kodim{number:02d}.png")
    for number, picture in zip(HELD_OUT_OF_KODAK, held_out(tmp_path).values(), strict=True):
        assert picture.shape == (1, 3, 60, 90)
        torch.testing.assert_close(picture[0, 0, 0, 0], torch.tensor(number / 255))
    mosaic = large(tmp_path, 100)
    assert mosaic.shape == (1, 3, 100, 100)
    assert {round(float(value) * 255) for value in mosaic.unique()} == set(PIECES)


def test_the_style_of_the_benchmark_depends_on_the_photograph_and_keeps_greys() -> None:
    grey = torch.linspace(0.1, 0.9, 64).view(1, 1, 8, 8).expand(-1, 3, -1, -1)
    styled = style(grey)
    torch.testing.assert_close(styled, styled.mean(1, keepdim=True).expand(-1, 3, -1, -1))
    patch = torch.tensor([0.2, 0.6, 0.3]).view(1, 3, 1, 1)
    warm, cold = (
        torch.tensor(colour).view(1, 3, 1, 1).expand(-1, -1, 8, 8) for colour in ((0.7, 0.4, 0.1), (0.1, 0.4, 0.7))
    )
    results = [style(torch.cat([patch.expand(-1, -1, 8, 1), around], dim=3))[0, :, 0, 0] for around in (warm, cold)]
    assert (results[0] - results[1]).abs().max() > 0.05


def test_networks_of_the_benchmark_start_from_a_look_and_learn() -> None:
    image = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    network = StyleNetwork(curves=True, matrix=True, lattices=2)
    result = network(image)
    assert result.shape == image.shape
    result.square().mean().backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in network.parameters())
