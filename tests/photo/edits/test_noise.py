"""Hot and dead pixels are replaced; stars, texture, text, dithering and compression are left alone."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.photo import Step, denoise, stream
from nlfilter_torch.photo.cli import editing, main
from nlfilter_torch.photo.edits import noise as module
from nlfilter_torch.photo.edits.noise import MARGIN, hot_pixels_of, in_order
from nlfilter_torch.photo.picture.in_memory import InMemory
from tests.pairwise import each_value
from tests.problems import colour, luminance


def smooth(size: int = 160) -> Tensor:
    """A slope, (1, 1, H, W)."""
    rows, columns = torch.meshgrid(*[torch.linspace(0, 1, size)] * 2, indexing="ij")
    return (0.3 + 0.3 * columns + 0.2 * rows)[None, None]


def damaged(image: Tensor, share: float, seed: int = 0) -> Tensor:
    """An image with hot and dead pixels."""
    draw = np.random.default_rng(seed)
    result = image.clone()
    height, width = image.shape[2:]
    places = draw.choice(height * width, round(share * height * width), replace=False)
    result.flatten(2)[..., places] = torch.from_numpy(draw.integers(0, 2, len(places))).to(image)
    return result


def eight_bits(image: Tensor) -> Tensor:
    return (image.clamp(0, 1) * 255).round() / 255


def count(image: Tensor) -> list[int]:
    pixels = hot_pixels_of(InMemory(image))
    return [] if pixels is None else pixels.count.int().tolist()


def median_of_nine(image: Tensor) -> Tensor:
    padded = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="reflect")
    return padded.unfold(2, 3, 1).unfold(3, 3, 1).flatten(4).median(4).values


@pytest.mark.parametrize("share", [0.0005, 0.003, 0.006])
def test_the_error_comes_near_that_of_a_median(share: float) -> None:
    clean = eight_bits(smooth())
    bad = damaged(clean, share)
    before, after, median = (
        255 * float((x - clean).abs().mean()) for x in (bad, eight_bits(denoise(bad)), median_of_nine(bad))
    )
    assert after < median + 0.005
    assert after < 0.1 * before


def test_photographs_lose_their_hot_pixels_and_nothing_else() -> None:
    clean = colour("coffee", 200, 240)
    bad = damaged(clean, 0.003)
    marked = (bad != clean).any(1)
    pixels = hot_pixels_of(InMemory(bad))
    assert pixels is not None
    fixed = pixels.removed(bad)
    changed = (fixed != bad).any(1)
    assert int(pixels.count) == int(changed.sum())
    assert float((changed & marked).sum() / marked.sum()) > 0.7
    assert int((changed & ~marked).sum()) <= 3
    assert float((fixed - clean).abs().mean()) < 0.4 * float((bad - clean).abs().mean())


def test_a_single_channel_of_a_noisy_picture() -> None:
    clean = smooth().expand(-1, 3, -1, -1)
    noisy = clean + 5 / 255 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    bad = noisy.clone()
    places = torch.randperm(160 * 160, generator=torch.Generator().manual_seed(1))[:60]
    bad[:, 1].flatten(1)[:, places] = 1.0
    pixels = hot_pixels_of(InMemory(bad))
    assert pixels is not None
    assert 55 <= int(pixels.count) <= 62
    fixed = pixels.removed(bad)
    assert torch.equal(fixed[:, ::2], bad[:, ::2])
    assert float((fixed - noisy).abs().amax()) < 0.2


@pytest.mark.parametrize(
    "name",
    [
        "camera",
        "coffee",
        "chelsea",
        "astronaut",
        "hubble_deep_field",
        "page",
        "text",
        "moon",
        "brick",
        "grass",
        "gravel",
    ],
)
def test_photographs_have_none(name: str) -> None:
    picture = getattr(skimage.data, name)()
    planes = torch.from_numpy(picture.copy()).float() / 255
    image = planes[None, None] if planes.ndim == 2 else planes.permute(2, 0, 1)[None]
    assert count(image) == [0]
    if name == "coffee":
        stream_of_bytes = io.BytesIO()
        for quality in (40, 85, 95):
            Image.fromarray(picture).save(stream_of_bytes, "JPEG", quality=quality)
            compressed = torch.from_numpy(np.asarray(Image.open(stream_of_bytes)).copy()).permute(2, 0, 1)[None] / 255
            assert count(compressed) == [0]
            assert count(compressed.mean(1, keepdim=True)) == [0]


@pytest.mark.parametrize(("noise", "width"), each_value([0.0, 3.0], [0.5, 0.7, 1.0, 1.5]))
def test_stars_are_kept(width: float, noise: float) -> None:
    draw = np.random.default_rng(0)
    rows, columns = np.mgrid[:200, :200]
    sky = np.full((200, 200), 0.05)
    for _ in range(80):
        y, x, light = *(draw.random(2) * 200), 0.05 + 0.1 * draw.pareto(1.5)
        sky += light * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * width**2))
    sky += noise / 255 * draw.standard_normal(sky.shape)
    image = eight_bits(torch.from_numpy(sky)[None, None].float())
    assert count(image) == [0]
    assert count(image.expand(-1, 3, -1, -1)) == [0]


def text(mode: str, ground: tuple[int, int, int], ink: tuple[int, int, int]) -> Image.Image:
    image = Image.new("RGB", (300, 200), ground)
    draw = ImageDraw.Draw(image)
    for row in range(0, 200, 13):
        draw.text((4, row), "The quick brown fox. jumps; over: the lazy dog, i.e. 3.14159 ...", fill=ink)
    return image.convert(mode)


def test_text_and_dithering_are_kept() -> None:
    camera = Image.fromarray(skimage.data.camera()[::2, ::2].copy())
    light = camera.point(lambda level: 255 - (255 - level) // 12)
    coffee = Image.fromarray(skimage.data.coffee())
    pictures = [
        text("L", (255,) * 3, (0, 0, 0)),
        text("1", (255,) * 3, (0, 0, 0)),
        text("RGB", (250, 250, 240), (20, 30, 90)),
        text("L", (10, 10, 10), (230,) * 3),
        camera.convert("1"),
        light.convert("1"),
        coffee.quantize(16).convert("RGB"),
        coffee.quantize(256).convert("RGB"),
    ]
    for picture in pictures:
        values = np.asarray(picture.convert("L") if picture.mode == "1" else picture).copy()
        planes = torch.from_numpy(values).float() / 255
        assert count(planes[None, None] if planes.ndim == 2 else planes.permute(2, 0, 1)[None]) == [0]


def test_noise_and_degenerate_pictures_have_none() -> None:
    generator = torch.Generator().manual_seed(0)
    for level in (2, 10, 40):
        noisy = eight_bits(smooth() + level / 255 * torch.randn(1, 1, 160, 160, generator=generator))
        assert count(noisy) == [0]
    assert count(torch.full((2, 3, 20, 20), 0.5)) == [0, 0]
    assert count(torch.rand(1, 3, 4, 60)) == []
    assert count(damaged(smooth(), 0.05)) == [0]  # not rare


def test_pictures_of_a_batch_and_other_ranges() -> None:
    clean = eight_bits(smooth())
    bad = damaged(clean, 0.003)
    assert count(torch.cat([clean, bad])) == [0, *count(bad)]
    assert count(65535 * bad) == count(bad)
    assert count((1e-3 * bad).double()) == count(bad)
    assert torch.equal(denoise(bad, noise_level=0.0), bad)
    assert torch.equal(denoise(bad, strength=0.0), bad)


@dataclass(frozen=True)
class Rows:
    """A block of rows of a batch."""

    pixels: torch.Tensor
    inner: Inner
    image: torch.Tensor
    first: int
    width: int
    weights: torch.Tensor | None = None


def test_parts_have_the_numbers_of_the_whole() -> None:
    image, floor = torch.rand(2, 3, 60, 40, generator=torch.Generator().manual_seed(0)), torch.tensor([0.01, 0.02])
    image[:, :, 17, 20] = 9.0
    whole = module._numbers(InMemory(image), floor)
    total, values = torch.zeros(()), []
    for start in range(0, 60, 17):
        first, stop = max(start - MARGIN, 0), min(start + 17, 60)
        part, inner = image[:, :, first : stop + MARGIN], (slice(start - first, stop - first), slice(None))
        numbers = module._numbers(Rows(part, inner, part[..., *inner], start * 40, 40), floor)
        total = total + numbers.numbers
        values.append(numbers.values)
    assert torch.equal(total, whole.numbers)
    assert torch.equal(torch.cat(values, 1).unique(dim=1), whole.values.unique(dim=1))
    assert int(total[0, 0]) > 0


def test_gradients_pass_through() -> None:
    bad = damaged(eight_bits(smooth(40)), 0.005).requires_grad_()
    pixels = hot_pixels_of(InMemory(bad))
    assert pixels is not None
    assert int(pixels.count) > 0
    pixels.removed(bad).sum().backward()
    assert bad.grad is not None
    assert int((bad.grad == 0).sum()) == int(pixels.count)


@pytest.mark.parametrize("tiled", [False, True])
def test_the_command_says_how_many(
    tiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if tiled:
        monkeypatch.setattr(editing, "read_if_it_fits", lambda *_: None)
    bad = (
        (255 * damaged(eight_bits(luminance(colour("coffee", 128, 160))), 0.002)[0, 0]).round().to(torch.uint8).numpy()
    )
    Image.fromarray(bad).save(tmp_path / "in.png")
    assert main(["denoise", str(tmp_path / "in.png"), str(tmp_path / "out.png")]) == 0
    said = capsys.readouterr().out
    number = count(torch.from_numpy(bad)[None, None] / 255)[0]
    assert number > 20
    assert f"{number} hot or dead pixels replaced" in said
    after = np.asarray(Image.open(tmp_path / "out.png"))
    edited = np.empty_like(bad)
    stream(Step("denoise"), bad, edited, tile_rows=16)
    assert np.abs(after.astype(int) - edited).max() <= 1


def test_few_values_of_many_pixels_are_sorted() -> None:
    for count in [1, 2, 3, 5, 8, 24]:
        values = torch.rand(count, 50, generator=torch.Generator().manual_seed(count)).round(decimals=1)
        assert torch.equal(torch.stack(in_order(values)), values.sort(0).values)
