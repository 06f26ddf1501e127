"""Looks as functions and layers: what their parts do, tiles, gradients and learning."""

from pathlib import Path

import numpy as np
import pytest
import skimage.color
import skimage.data
import skimage.exposure
import torch
from torch import Tensor

from nlfilter_torch import Look, apply_look, enhance, fit_look
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.looks.look_filter import bands_of, tone_curve
from nlfilter_torch.photo.tiled.recipe import edit_rows
from nlfilter_torch.photo.tiled.tiles import Passes
from tests.looks import ALPHA, CAT, CUP, FEW, SEPIA, in_bytes, one

BENT = tuple((i / 16) ** 0.7 for i in range(17))
VIVID = (1.3, 1.2, 1.1, 1.05, 1.0)
BANDS = (1.5, 1.0, 1.3, 1.0, 1.0, 0.8, 1.1)
TEXTURE = (1.4, 0.8, 1.2, 1.0, 1.1, 0.9)
STRETCH = (0.3, 0.4, -0.2)
LOCAL = (0.2, 0.3, -0.1, 0.2, 0.1, -0.1, 0.2, 0.1)


def test_a_look_that_changes_nothing_is_the_image() -> None:
    assert torch.equal(apply_look(CAT), CAT)
    assert not Step("look").changes()
    assert torch.equal(Look()(CAT).detach(), CAT)


def test_bands_add_up_to_the_image() -> None:
    bands = list(bands_of(CAT.double()))
    assert len(bands) == 7
    assert torch.allclose(sum(bands[1:], bands[0]), CAT.double(), atol=1e-12)
    assert all(bands[i].square().mean() > 0 for i in range(7))


def test_the_parts_are_what_they_say() -> None:
    points = torch.tensor(BENT)
    by_hand = torch.from_numpy(np.interp(CAT.numpy(), [i / 16 for i in range(17)], BENT)).float()
    assert torch.allclose(tone_curve(CAT, points.expand(3, -1)), by_hand, atol=1e-6)
    sepia = torch.tensor(SEPIA).view(3, 3)
    assert torch.allclose(apply_look(CAT, matrix=SEPIA), torch.einsum("cd,bdhw->bchw", sepia, CAT), atol=1e-6)
    contrast = apply_look(CAT, bands=(1.4,) * 7)
    mean = (CAT * torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)).sum(1).mean()
    assert torch.allclose(contrast, mean + 1.4 * (CAT - mean), atol=1e-5)
    sliders = apply_look(CAT, alpha=ALPHA, num_landmarks=40)
    detail = enhance(CAT, torch.tensor(ALPHA), limits="none", threshold=0.0, num_landmarks=40)
    assert torch.allclose(sliders, detail, atol=1e-5)
    hsv = skimage.color.rgb2hsv(CAT[0].permute(1, 2, 0).double().numpy())
    hsv[..., 1] *= np.interp(hsv[..., 1], [0, 0.25, 0.5, 0.75, 1], VIVID)
    by_hand = torch.from_numpy(skimage.color.hsv2rgb(hsv)).permute(2, 0, 1)[None].float()
    assert torch.allclose(apply_look(CAT, saturation=VIVID), by_hand, atol=1e-5)
    assert torch.allclose(
        apply_look(CAT, matrix=SEPIA, amount=0.5), (CAT + apply_look(CAT, matrix=SEPIA)) / 2, atol=1e-6
    )


def test_texture_is_the_fine_band_where_luminance_varies_little() -> None:
    image = CAT.double()
    light = (image * torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(3, 1, 1)).sum(1)[0].numpy()
    weights = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256

    def blurred(row: int, column: int, values: np.ndarray) -> float:
        return float((values[row - 2 : row + 3, column - 2 : column + 3] * weights).sum())

    found = apply_look(image, texture=(2.0, 1.0, 1.0, 1.0, 1.0, 1.0)) - image
    for row, column in ((2, 2), (30, 41), (60, 80)):
        mean = blurred(row, column, light)
        variance = blurred(row, column, light**2) - mean**2
        change = (light[row, column] - mean) * 0.15**2 / (0.15**2 + variance)
        assert found[0, :, row, column].tolist() == pytest.approx([change] * 3, abs=1e-9)


@pytest.mark.parametrize("scaled", [False, True])
def test_local_contrast_is_the_clipped_histogram_of_the_tiles_around(scaled: bool) -> None:
    image = CAT[:, :, :77, :90].double()  # tiles of 9.6 by 11.3 pixels
    strengths = [0.0] * 8
    strengths[4 * scaled + 1] = 1.0  # a limit of 2
    found = apply_look(image, local=strengths) - image
    weights = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(3, 1, 1)
    light = (image[0].amax(0) if scaled else (image[0] * weights).sum(0)).numpy()
    value = light
    if scaled:
        light = (light - light.min()) / (light.max() - light.min())
    hats = np.maximum(1 - np.abs(light * 32 - np.arange(33)[:, None, None]), 0)

    def inside(tile: int, length: int) -> np.ndarray:  # how much of each pixel is in it
        edges = np.array([tile, tile + 1]) * length / 8
        starts = np.arange(length)
        return np.clip(np.minimum(starts + 1, edges[1]) - np.maximum(starts, edges[0]), 0, None)

    def curve(row: int, column: int) -> np.ndarray:  # of the tile with that number
        shares = np.outer(inside(row, 77), inside(column, 90))
        clipped = np.minimum((hats * shares).sum((1, 2)) / shares.sum(), 2 / 33)
        clipped += (1 - clipped.sum()) / 33
        return clipped.cumsum() - clipped / 2 - np.linspace(0, 1, 33)

    for row, column in ((0, 0), (2, 2), (40, 33), (76, 89), (74, 12)):
        place = [
            min(max((i + 0.5) * 8 / length - 0.5, 0), 7) for i, length in ((row, 77), (column, 90))
        ]  # in numbers of tiles
        blended = np.zeros(33)
        for i in {int(place[0]), min(int(place[0]) + 1, 7)}:
            for j in {int(place[1]), min(int(place[1]) + 1, 7)}:
                blended += (1 - abs(place[0] - i)) * (1 - abs(place[1] - j)) * curve(i, j)
        change = np.interp(light[row, column], np.linspace(0, 1, 33), blended)
        colours = image[0, :, row, column] / value[row, column] if scaled else torch.ones(3)
        assert found[0, :, row, column].tolist() == pytest.approx((change * colours).tolist(), abs=1e-6)
    even = torch.full((1, 3, 5, 40), 0.5)  # tiles of less than a pixel
    assert torch.isfinite(apply_look(even, local=LOCAL)).all()


def test_automatic_levels_reach_from_black_to_white() -> None:
    dull = CAT * 0.4 + 0.2
    weights = torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)
    for kind, tone in enumerate((lambda x: (x * weights).sum(1), lambda x: x.amax(1), lambda x: x)):
        strengths = [0.0] * 3
        strengths[kind] = 1.0
        found = tone(apply_look(dull, stretch=strengths))
        low, high = tone(dull).min(), tone(dull).max()
        if kind == 2:
            low, high = (torch.stack([of(x) for x in dull[0]]).view(3, 1, 1) for of in (torch.min, torch.max))
        assert torch.allclose(found, (tone(dull) - low) / (high - low), atol=1e-5)
    value = apply_look(dull, stretch=(0.0, 1.0, 0.0))
    assert torch.allclose(value * dull.amax(1, True), dull * value.amax(1, True), atol=1e-5)  # hue and saturation stay
    grey = apply_look(dull[:, :1], stretch=(0.0, 0.0, 1.0))
    assert [float(grey.min()), float(grey.max())] == pytest.approx([0, 1], abs=1e-5)


def test_automatic_levels_leave_flat_pictures_alone() -> None:
    for even in (torch.zeros(1, 3, 9, 9), torch.full((1, 3, 9, 9), 0.7)):
        assert torch.equal(apply_look(even, stretch=STRETCH), even)
        assert torch.isfinite(apply_look(even, local=LOCAL)).all()


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
    found = one(fit_look([(CAT, after)], step=FEW))
    assert torch.allclose(Look(found.tensors, learn=())(CAT), found.apply(CAT), atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"matrix": (1.0, 0.0)}, "matrix must be 9 numbers"),
        ({"red": (0.0, 1.0)}, "red, green and blue must be equally many"),
        ({"bands": (1.0, 1.0)}, "bands must have the shape"),
        ({"texture": (1.0,)}, "texture must have the shape"),
        ({"alpha": (1.0,)}, "alpha must have the shape"),
        ({"local": (1.0,)}, "local must have the shape"),
        ({"stretch": (1.0,)}, "stretch must have the shape"),
    ],
)
def test_bad_parts_are_refused(options: dict[str, tuple[float, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        apply_look(CAT, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("part", ["alpha", "local", "texture"])
def test_half_precision_pictures_are_computed_in_float32(part: str, dtype: torch.dtype) -> None:
    exact = CAT.to(dtype).float()
    parts = {
        "alpha": torch.tensor([2.5, 1.7, 1.3, 1.0]),
        "local": torch.full((8,), 0.1),
        "texture": torch.full((6,), 1.3),
    }
    look = Look({part: parts[part]}, num_landmarks=20)
    expected, found = look(exact), look(exact.to(dtype))
    assert found.dtype == dtype
    torch.testing.assert_close(found, expected.to(dtype), atol=0, rtol=0)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(look(exact), expected)


@pytest.mark.parametrize(("name", "value"), [("bands", torch.nan), ("curves", torch.inf)])
def test_parts_that_are_not_finite_are_refused(name: str, value: float) -> None:
    part = torch.full((7,) if name == "bands" else (3, 17), value)
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        Look()(CAT, **{name: part})
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        Look({name: part})
