"""Looks: applying them in memory and in tiles, fitting them to pairs, and their files."""

import gc
import json
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import skimage.color
import skimage.data
import torch
from torch import Tensor

from nlfilter_torch import FittedLook, Look, apply_look, enhance, fit_look
from nlfilter_torch.cli import main
from nlfilter_torch.edits.alignment import align
from nlfilter_torch.edits.applying import apply_step
from nlfilter_torch.edits.recipe import Recipe
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.filtering.look import bands_of, tone_curve
from nlfilter_torch.filtering.look_fit import MOST, nonnegative, sample
from nlfilter_torch.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.tiled.recipe import edit_rows
from nlfilter_torch.tiled.tiles import Passes

ALPHA = (2.2, 1.6, 1.3, 1.02)
SEPIA = (0.393, 0.769, 0.189, 0.349, 0.686, 0.168, 0.272, 0.534, 0.131)
BENT = tuple((i / 16) ** 0.7 for i in range(17))
FEW = Step("look", landmarks=40)
VIVID = (1.3, 1.2, 1.1, 1.05, 1.0)
BANDS = (1.5, 1.0, 1.3, 1.0, 1.0, 0.8, 1.1)


def rgb(name: str, rows: slice, columns: slice) -> Tensor:
    return torch.from_numpy(getattr(skimage.data, name)()[rows, columns].copy()).permute(2, 0, 1)[None].float() / 255


CAT = rgb("chelsea", slice(60, 140), slice(100, 200))
CUP = rgb("coffee", slice(100, 180), slice(150, 250))
SUIT = rgb("astronaut", slice(60, 140), slice(150, 250))


def in_bytes(image: Tensor) -> Tensor:
    return (image.clamp(0, 1) * 255).round() / 255


def one(found: FittedLook | tuple[FittedLook, ...]) -> FittedLook:
    assert isinstance(found, FittedLook)
    return found


def explained(before: Tensor, after: Tensor, found: Tensor) -> float:
    return 1 - float((after - found.clamp(0, 1)).square().sum() / (after - before).square().sum())


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


@pytest.mark.parametrize("viewing", [0.0, 0.004])
@pytest.mark.parametrize("channels", [1, 3])
def test_tiles_are_the_image_in_memory(viewing: float, channels: int, tmp_path: Path) -> None:
    step = Step(
        "look", alpha=ALPHA, bands=BANDS, red=BENT, green=BENT, blue=BENT, matrix=SEPIA, saturation=VIVID, amount=0.8,
        landmarks=30, viewing_size=viewing,
    )  # fmt: skip
    image = CAT[:, :channels]
    whole = apply_step(step, image)
    passes = Passes(memory=1 << 30, tile_rows=13, kind="float32", folder=tmp_path)
    rows = [values for _, values in edit_rows(passes, image[0].permute(1, 2, 0).numpy(), Recipe((step,)), "it")]
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

    def look(image: Tensor, bands: Tensor, curve: Tensor, matrix: Tensor, vivid: Tensor) -> Tensor:
        parts = {"red": curve, "green": curve, "blue": BENT, "matrix": matrix, "saturation": vivid}
        return apply_look(image, bands=bands, **parts).sum(1)

    with torch.no_grad():
        image.add_(1e-3)  # away from the knots of the curve, where it has no derivative
    assert torch.autograd.gradcheck(look, (image, bands, curve, matrix, vivid), fast_mode=True)
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
    with pytest.raises(ValueError, match="learn must name"):
        Look(learn=("colour",))


def test_the_layer_takes_what_was_found() -> None:
    after = in_bytes(apply_look(CAT, matrix=SEPIA))
    found = one(fit_look([(CAT, after)], step=FEW))
    assert torch.allclose(Look(found.tensors, learn=())(CAT), found.apply(CAT), atol=1e-5)


@pytest.mark.parametrize("count", [1, 2])
def test_sliders_are_found_through_eight_bits(count: int) -> None:
    images = (rgb("chelsea", slice(0, 300, 2), slice(0, 450, 2)), rgb("coffee", slice(0, 300, 2), slice(0, 450, 2)))
    step = Step("detail", alpha=ALPHA, limits="none", threshold=0.0, landmarks=150)
    pairs = [(image, in_bytes(apply_step(step, image))) for image in images[:count]]
    found = one(fit_look(iter(pairs), step=Step("look", landmarks=150)))
    assert found.parts == ("alpha",)
    assert found.step.edit == "detail"
    assert found.step["alpha"] == pytest.approx(ALPHA, abs=1e-3)
    assert found.fitted > 0.99
    assert torch.allclose(found.apply(images[0]).clamp(0, 1), pairs[0][1], atol=1.01 / 255)


@pytest.mark.parametrize(
    "edit",
    [
        lambda x: x**0.6,
        lambda x: 1 / (1 + torch.exp(8 * (0.5 - x))),
        lambda x: torch.einsum("cd,bdhw->bchw", torch.tensor(SEPIA).view(3, 3), x),
        lambda x: x * torch.tensor([1.15, 1.0, 0.85]).view(1, 3, 1, 1),
        lambda x: x.mean((2, 3), keepdim=True).mean() + 1.3 * (x - x.mean((2, 3), keepdim=True).mean()),
    ],
    ids=["gamma", "sigmoid", "sepia", "warmth", "contrast"],
)
def test_edits_of_others_are_explained_on_other_photographs(edit: object) -> None:
    assert callable(edit)
    pairs = [(image, in_bytes(edit(image))) for image in (CAT, CUP, SUIT)]
    found = one(fit_look(pairs[:2], step=FEW))
    assert all(explained(*pair, found.apply(pair[0])) > 0.95 for pair in pairs)


def test_saturation_in_hsv_is_explained_on_other_photographs() -> None:
    def saturated(image: Tensor) -> Tensor:
        hsv = skimage.color.rgb2hsv(image[0].permute(1, 2, 0).numpy())
        hsv[..., 1] = (1.4 * hsv[..., 1]).clip(0, 1)
        return in_bytes(torch.from_numpy(skimage.color.hsv2rgb(hsv)).permute(2, 0, 1)[None].float())

    every = slice(0, 512, 5)  # small pictures with colours of all kinds
    pairs = [
        (image, saturated(image)) for image in (rgb(name, every, every) for name in ("astronaut", "coffee", "chelsea"))
    ]
    found = one(fit_look(pairs[:2], step=FEW))
    assert found.parts == ("saturation",)
    assert all(explained(*pair, found.apply(pair[0])) > 0.99 for pair in pairs)


def test_sums_of_samples_are_those_of_all_pixels() -> None:
    generator = torch.Generator().manual_seed(0)
    whole = torch.rand(300, 400, generator=generator) + 0.1
    whole[:, :50] = 0
    places = sample(whole)
    assert len(places) == MOST
    assert len(set(places.tolist())) > 0.9 * MOST
    assert bool((whole.flatten()[places] > 0).all())
    assert torch.equal(places, places.sort().values)
    assert float(whole.flatten()[places].mean()) == pytest.approx(float(whole[:, 50:].mean()), abs=2e-3)
    assert torch.equal(sample(whole[:50]), whole[:50].flatten().nonzero().squeeze(1))


def test_a_sampled_pair_and_a_whole_one_have_the_same_look() -> None:
    large = torch.nn.functional.interpolate(CAT, (320, 400), mode="bicubic").clamp(0, 1)  # 128,000 pixels
    step = Step("detail", alpha=ALPHA, limits="none", threshold=0.0, landmarks=40, viewing_size=0.0)
    sliders = one(fit_look([(large, in_bytes(apply_step(step, large)))], step=FEW.changed(viewing_size=0.0)))
    assert sliders.step["alpha"] == pytest.approx(ALPHA, abs=1e-3)
    curve = one(fit_look([(large, in_bytes(large**0.7))], step=FEW))
    assert explained(large, large**0.7, curve.apply(large)) > 0.99


def test_one_pair_does_not_bend_curves_where_it_has_no_values() -> None:
    dark = in_bytes(0.1 + 0.25 * CAT)
    found = one(fit_look([(dark, in_bytes(dark + 0.8 * dark * (0.5 - dark)))], parts=("curves",), step=FEW))
    curves = found.tensors["curves"]
    assert found.fitted > 0.9
    assert float((curves[:, 12:] - torch.linspace(0, 1, 17)[12:]).abs().max()) < 0.08


def test_curves_never_fall() -> None:
    after = in_bytes(0.5 + 0.4 * torch.sin(9 * CAT))  # a curve that rises and falls
    found = one(fit_look([(CAT, after)], parts=("curves",), step=FEW))
    curves = found.tensors["curves"]
    assert float(curves.diff(dim=1).min()) >= -1e-5
    assert float(curves.diff(dim=1).max()) > 0.01


def test_nonnegative_least_squares_meets_its_conditions() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        root = torch.rand(12, 8, generator=generator, dtype=torch.float64) - 0.3
        matrix, vector = root.mT @ root, torch.rand(8, generator=generator, dtype=torch.float64) - 0.5
        found = nonnegative(matrix, vector)
        slope = vector - matrix @ found
        assert float(found.min()) >= 0
        assert float(slope.max()) < 1e-8
        assert float((slope * found).abs().max()) < 1e-8


def test_pairs_are_read_once_and_not_kept() -> None:
    alive: list[bool] = []
    yielded: list[weakref.ref[Tensor]] = []

    def pairs() -> Iterator[tuple[Tensor, Tensor]]:
        for number in range(6):
            image = CAT.roll(number, 2)
            yielded.append(weakref.ref(image))
            yield image, in_bytes(image**0.7)
            del image
            gc.collect()
            alive.extend(reference() is not None for reference in yielded[:-1])

    found = one(fit_look(pairs(), step=FEW))
    assert len(yielded) == 6
    assert len(alive) == 15
    assert not any(alive)
    assert found.left_out > 0.95


def test_regions_have_looks_of_their_own() -> None:
    masks = torch.zeros(1, 2, *CAT.shape[-2:])
    masks[:, 0, :, :50], masks[:, 1, :, 50:] = 1, 1
    bright, sepia = in_bytes(CAT**0.6), in_bytes(apply_look(CAT, matrix=SEPIA))
    found = fit_look([(CAT, torch.where(masks[:, :1] > 0, bright, sepia), masks)], step=FEW)
    assert isinstance(found, tuple)
    left, right = (look.apply(CAT) for look in found)
    assert explained(CAT[..., :50], bright[..., :50], left[..., :50]) > 0.98
    assert explained(CAT[..., 50:], sepia[..., 50:], right[..., 50:]) > 0.98


def test_a_watermark_lowers_what_is_explained_and_little_else() -> None:
    after = in_bytes(CAT**0.6)
    after[..., 60:75, 60:95] = 0.9
    found = one(fit_look([(CAT, after)], step=FEW))
    assert 0 < found.fitted < 0.95
    assert explained(CAT[..., :55, :], after[..., :55, :], found.apply(CAT)[..., :55, :]) > 0.8


def test_more_parameters_than_pixels_are_told_by_what_is_left_out() -> None:
    noise = torch.rand(1, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    found = one(fit_look([(CAT[..., :5, :5], noise)], step=Step("look", landmarks=20)))
    assert found.left_out < 0.5
    assert all(abs(value) < 1e3 for value in found.tensors["alpha"].tolist())


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([], "pairs must hold a pair"),
        ([(CAT, CAT)], "each is the same before and after"),
        ([(CAT, torch.zeros_like(CAT))], "not clipped to black or white"),
        ([(CAT, CUP.flip(2, 3))], "must be an edit of before of pair 1"),
        ([(CAT, CAT[..., :50])], "after of pair 1"),
        ([CAT], "pairs must hold tuples"),
        ([(CAT, CAT**0.5, torch.zeros_like(CAT))], "masks must hold a pixel"),
    ],
)
def test_bad_pairs_are_refused_in_a_sentence(pairs: list[object], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as error:
        fit_look(pairs, step=FEW)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"matrix": (1.0, 0.0)}, "matrix must be 9 numbers"),
        ({"red": (0.0, 1.0)}, "red, green and blue must be equally many"),
        ({"bands": (1.0, 1.0)}, "bands must have the shape"),
        ({"alpha": (1.0,)}, "alpha must have the shape"),
    ],
)
def test_bad_parts_are_refused(options: dict[str, tuple[float, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        apply_look(CAT, **options)  # type: ignore[arg-type]


def test_files_keep_looks(tmp_path: Path) -> None:
    found = one(fit_look([(CAT, in_bytes(CAT**0.6))], step=FEW))
    text = found.to_json()
    assert json.loads(text)["steps"][0]["edit"] == "look"
    assert Recipe.from_json(text, "it").steps == (found.step,)
    with pytest.raises(ValueError, match="matrix of look, step 1 in it must be a list of 9 numbers"):
        Recipe.from_json('{"version": 1, "steps": [{"edit": "look", "matrix": [1, 2]}]}', "it")


@pytest.mark.parametrize(
    ("cut", "row", "column"), [((slice(7, 67), slice(12, 92)), 7, 12), ((slice(0, 60), slice(20, 100)), 0, 20)]
)
def test_crops_are_found(cut: tuple[slice, slice], row: int, column: int) -> None:
    after = (CAT**0.6)[(..., *cut)]
    part, edited, done = align(CAT, after, "before", "after")
    assert torch.equal(part, CAT[(..., *cut)])
    assert torch.equal(edited, after)
    assert f"row {row}, column {column}" in done


def test_shifts_and_sizes_are_found() -> None:
    before, after = CAT[..., 5:, :-3], (CAT**0.6)[..., :-5, 3:]
    first, second, done = align(before, after, "before", "after")
    assert "5 pixels down and -3" in done
    assert torch.allclose(first**0.6, second, atol=1e-6)
    small = torch.nn.functional.interpolate(CAT**0.6, (40, 50), mode="area")
    _, resized, done = align(CAT, small, "before", "after")
    assert resized.shape == CAT.shape
    assert "resized from 50x40 to 100x80" in done
    with pytest.raises(ValueError, match="after must have the size of before"):
        align(CAT, CUP[..., :30, :70], "before", "after")


def test_the_command_fits_folders_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, edit in (("before", lambda x: x), ("after", lambda x: x**0.6)):
        (tmp_path / folder).mkdir()
        for name, image in (("cat", CAT), ("cup", CUP)):
            write_photograph(Photograph(edit(image)), tmp_path / folder / f"{name}.png")
    look, seen, rest = (tmp_path / name for name in ("look.json", "seen.png", "rest.png"))
    folders = [str(tmp_path / name) for name in ("before", "after")]
    drawn = ["--preview", str(seen), "--map", str(rest)]
    assert main(["fit", *folders, str(look), "--landmarks", "40", *drawn]) == 0
    printed = capsys.readouterr().out
    assert "in other photographs" in printed
    assert float(printed.split("explained: ")[1].split(" %")[0]) > 98
    assert read_photograph(seen).size == (80, 400)
    assert read_photograph(rest).size == (80, 100)
    before, out = tmp_path / "before" / "cup.png", tmp_path / "out.png"
    for command in ("detail", "apply"):
        assert main([command, str(before), str(out), "--preset", str(look)]) == 0
        assert (read_photograph(out).pixels - in_bytes(CUP**0.6)).abs().mean() < 2 / 255
    assert main(["detail", str(before), str(out), "--preset", str(look), "--alpha", "1,2"]) == 2
    assert "must not be combined with other options of detail" in capsys.readouterr().err


def test_the_command_warns_of_a_local_edit_and_fits_regions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, mask, look = (str(tmp_path / name) for name in ("a.png", "b.png", "m.png", "look.json"))
    local = CAT.clone()
    local[..., 32:48, 48:64] = (CAT[..., 32:48, 48:64] + 0.3).clamp(0, 0.99)
    region = torch.zeros_like(CAT[:, :1])
    region[..., 32:48, 48:64] = 1
    for path, image in ((before, CAT), (after, local), (mask, region)):
        write_photograph(Photograph(image), Path(path))
    assert main(["fit", before, after, look, "--landmarks", "40"]) == 0
    told = capsys.readouterr().err
    assert "explains less than 80 %" in told
    assert "around row 32, column 48" in told
    assert main(["fit", before, after, look, "--landmarks", "40", "--mask", mask]) == 0
    assert float(capsys.readouterr().out.split("explained: ")[1].split(" %")[0]) > 95
    assert (tmp_path / "look-1.json").exists()
    assert main(["fit", before, after, look, "--mask", mask, "--preview", str(tmp_path / "seen.png")]) == 2
    assert "--preview shows a single look, but --mask asks for 1" in capsys.readouterr().err


def test_the_command_refuses_what_does_not_belong_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after, look = (tmp_path / name for name in ("a.png", "b.png", "look.json"))
    write_photograph(Photograph(CAT), before)
    write_photograph(Photograph(CUP.flip(2, 3)), after)
    assert main(["fit", str(before), str(after), str(look), "--landmarks", "40"]) == 2
    assert "check that they show the same picture" in capsys.readouterr().err
    assert main(["fit", str(tmp_path), str(after), str(look)]) == 2
    assert "two photographs or two folders" in capsys.readouterr().err
    assert not look.exists()
