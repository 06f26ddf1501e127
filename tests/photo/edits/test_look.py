"""Looks as edits: tiles, batches, gradients and errors."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from nlfilter_torch.photo import Look, apply_look
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.look import colour_part, colour_table, table_error
from nlfilter_torch.photo.edits.recipe import edit_rows
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.tiles import Passes
from tests.looks import ALPHA, BANDS, BENT, CAT, CUP, LOCAL, SEPIA, STRETCH, TEXTURE, VIVID


def test_a_look_that_changes_nothing_is_the_image() -> None:
    assert torch.equal(apply_look(CAT), CAT)
    assert not Step("look").changes()
    assert torch.equal(Look()(CAT).detach(), CAT)


@pytest.mark.parametrize("viewing", [0.0, 0.004])
@pytest.mark.parametrize("channels", [1, 3])
def test_tiles_are_the_image_in_memory(viewing: float, channels: int, tmp_path: Path) -> None:
    step = Step(
        "look", alpha=ALPHA, bands=BANDS, texture=TEXTURE, red=BENT, green=BENT, blue=BENT, matrix=SEPIA,
        saturation=VIVID, stretch=STRETCH, local=LOCAL, amount=0.8, landmarks=30, viewing_size=viewing,
    )  # fmt: skip
    image = CAT[:, :channels]
    whole = apply_step(step, image)
    passes = Passes(memory=1 << 30, tile_rows=13, kind="float32", folder=tmp_path)
    rows = [values for _, values in edit_rows(passes, image[0].permute(1, 2, 0).numpy(), (step,), "it")]
    tiled = torch.cat([torch.from_numpy(part) for part in rows]).permute(2, 0, 1)[None]
    assert (tiled - whole).abs().max() < 2e-3
    assert (whole - image).abs().mean() > 0.02


def test_gradients_reach_image_and_look() -> None:
    image = CAT[..., :16, :20].double().requires_grad_()
    alpha = torch.tensor([1.5, 1.0, 1.0, 1.0], dtype=torch.float64, requires_grad=True)
    bands = torch.tensor(BANDS, dtype=torch.float64, requires_grad=True)
    curve = torch.tensor(BENT, dtype=torch.float64, requires_grad=True)
    matrix = torch.tensor(SEPIA, dtype=torch.float64, requires_grad=True)
    vivid = torch.tensor(VIVID, dtype=torch.float64, requires_grad=True)

    local = torch.tensor(LOCAL, dtype=torch.float64, requires_grad=True)

    texture = torch.tensor(TEXTURE, dtype=torch.float64, requires_grad=True)

    def look(image: Tensor, bands: Tensor, curve: Tensor, matrix: Tensor, vivid: Tensor, *rest: Tensor) -> Tensor:
        local, texture = rest
        parts = {
            "texture": texture,
            "red": curve,
            "green": curve,
            "blue": BENT,
            "matrix": matrix,
            "saturation": vivid,
            "local": local,
        }
        return apply_look(image, bands=bands, **parts).sum(1)

    with torch.no_grad():
        image.add_(1e-3)  # away from the knots of the curve, where it has no derivative
    assert torch.autograd.gradcheck(
        lambda image, levels: apply_look(image, stretch=levels),
        (image, torch.tensor(STRETCH, dtype=torch.float64, requires_grad=True)),
        fast_mode=True,
    )
    assert torch.autograd.gradcheck(look, (image, bands, curve, matrix, vivid, local, texture), fast_mode=True)
    apply_look(image, alpha=alpha, num_landmarks=20).square().mean().backward()
    assert alpha.grad is not None
    assert bool((alpha.grad != 0).all())


def test_looks_differ_within_a_batch() -> None:
    images = torch.cat([CAT, CUP])
    matrices = torch.stack([torch.eye(3).flatten(), torch.tensor(SEPIA)])
    both = apply_look(images, matrix=matrices)
    assert torch.allclose(both[:1], CAT, atol=1e-6)
    assert torch.allclose(both[1:], apply_look(CUP, matrix=SEPIA), atol=1e-6)


def test_complex_numbers_are_refused() -> None:
    with pytest.raises(TypeError, match=r"stretch must be real numbers, got torch\.complex64; pass"):
        apply_look(CAT, stretch=torch.zeros(3, dtype=torch.complex64))


def test_looks_of_colours_need_no_smaller_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(0))
    curve = [(step / 16) ** 0.8 for step in range(17)]
    whole = apply_look(image, red=curve, viewing_size=0.0)
    monkeypatch.delattr(InMemory, "resized")
    assert torch.equal(apply_look(image, red=curve, viewing_size=0.001), whole)
    with pytest.raises(AttributeError, match="resized"):
        apply_look(image, alpha=(2.0, 1.0, 1.0, 1.0), red=curve, viewing_size=0.001)


LOOK = Step("look", red=BENT, matrix=SEPIA, saturation=VIVID, amount=0.8)


def test_only_what_depends_on_the_colour_alone_is_in_the_table() -> None:
    whole = LOOK.changed(alpha=ALPHA, bands=BANDS, local=LOCAL, stretch=STRETCH)
    assert colour_part(whole) == LOOK
    assert colour_part(Step("detail")) == Step("look")
    assert torch.equal(colour_table(whole, 5), colour_table(LOOK, 5))


def test_the_table_holds_the_colours_of_its_nodes() -> None:
    nodes = colours_of_nodes(4).view(1, 3, 8, 8)
    torch.testing.assert_close(colour_table(LOOK, 4), apply_step(LOOK, nodes).view(3, 4, 4, 4))


def test_finer_tables_are_more_exact_and_exact_for_curves() -> None:
    curve = Step("look", red=BENT, green=BENT, blue=BENT)
    assert table_error(curve, 33, CAT) < 1e-3
    errors = [table_error(LOOK, nodes, CAT) for nodes in (5, 9, 33)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.5
