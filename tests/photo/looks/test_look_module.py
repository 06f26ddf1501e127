"""Looks as layers: learning, precision and errors."""

import pytest
import torch

from nlfilter_torch.photo import Look, apply_look, fit_look
from tests.looks import BENT, CAT, FEW, SEPIA, in_bytes, single_look
from tests.pairwise import each_value


def test_the_layer_learns_what_it_is_told_to() -> None:
    target = apply_look(CAT, red=BENT, green=BENT, blue=BENT)
    layer = Look(learn=("curves",))
    assert [name for name, _ in layer.named_parameters()] == ["curves"]
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.02)
    first = float((layer(CAT) - target).square().mean().detach())
    for _ in range(40):
        optimizer.zero_grad()
        loss = (layer(CAT) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert float(loss.detach()) < first / 20
    assert torch.equal(layer.matrix, torch.eye(3))
    with pytest.raises(ValueError, match="learn must hold only names from"):
        Look(learn=("colour",))


def test_the_layer_takes_what_was_found() -> None:
    after = in_bytes(apply_look(CAT, matrix=SEPIA))
    look = single_look(fit_look([(CAT, after)], step=FEW))
    assert torch.allclose(Look(look.tensors, learn=())(CAT), look.apply(CAT), atol=1e-5)


@pytest.mark.parametrize(("dtype", "part"), each_value([torch.float16, torch.bfloat16], ["alpha", "local", "texture"]))
def test_half_precision_pictures_are_computed_in_float32(part: str, dtype: torch.dtype) -> None:
    exact = CAT.to(dtype).float()
    parts = {
        "alpha": torch.tensor([2.5, 1.7, 1.3, 1.0]),
        "local": torch.full((8,), 0.1),
        "texture": torch.full((6,), 1.3),
    }
    look = Look({part: parts[part]}, num_landmarks=20)
    expected, result = look(exact), look(exact.to(dtype))
    assert result.dtype == dtype
    torch.testing.assert_close(result, expected.to(dtype), atol=0, rtol=0)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(look(exact), expected)


def test_pixels_far_apart_do_not_count_unless_the_spatial_bandwidth_is_none() -> None:
    sliders = {"alpha": torch.tensor([2.0, 1.5, 1.0, 1.0])}
    usual, near, far = (
        Look(sliders, num_landmarks=30, spatial_bandwidth=bandwidth)(CAT) for bandwidth in ("auto", 80 / 12, None)
    )
    assert torch.equal(usual, near)
    assert (far - near).abs().max() > 0.02
    with pytest.raises(ValueError, match="spatial_bandwidth must be"):
        Look(sliders, spatial_bandwidth="far")  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "value"), [("bands", torch.nan), ("curves", torch.inf)])
def test_parts_that_are_not_finite_are_refused(name: str, value: float) -> None:
    part = torch.full((7,) if name == "bands" else (3, 17), value)
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        Look()(CAT, **{name: part})
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        Look({name: part})
