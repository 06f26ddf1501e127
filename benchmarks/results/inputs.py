"""Small pictures of scikit-image as files and tensors, and recipes: the inputs of all results."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import av
import imagecodecs
import numpy as np
import skimage.data
import tifffile
import torch
import zarr
from numpy.typing import NDArray
from PIL import Image, ImageCms
from torch import Tensor

Bytes = NDArray[np.uint8]
Entries = dict[str, Any]

SIZE = (72, 96)  # (H, W) of photographs
SCAN = (300, 450)  # of those that are edited in tiles
LEFT, RIGHT = [[0.2, 0.3], [0.3, 0.5]], [[0.8, 0.7], [0.85, 0.8]]  # lines of strokes
DATE = slice(24, 36)  # of the bytes of a colour profile
EXIF = {0x010F: "Maker", 0x0110: "Model", 0x0112: 6, 0x0132: "2026:01:02 03:04:05"}  # 6: turned by a quarter
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"/></x:xmpmeta>'


@cache
def photograph(name: str, top: int = 60, left: int = 100, size: tuple[int, int] = SIZE) -> Bytes:
    """A part of a picture of scikit-image, (H, W) or (H, W, 3)."""
    picture: Bytes = getattr(skimage.data, name)()[top : top + size[0], left : left + size[1]].copy()
    picture.setflags(write=False)
    return picture


def profile() -> bytes:
    """A colour profile without the time at which it was made."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    data[DATE] = bytes(DATE.stop - DATE.start)
    return bytes(data)


def noisy(picture: Bytes, deviation: float) -> Bytes:
    """A picture with white noise of that standard deviation in grey levels."""
    added = np.random.default_rng(0).normal(0, deviation, picture.shape)
    return (picture + added).clip(0, 255).round().astype(np.uint8)


def brightened(picture: Bytes) -> Bytes:
    """A picture edited by a tone curve and less blue."""
    return (255 * (picture / 255) ** 0.7 * np.array([1.0, 1.0, 0.9])).round().astype(np.uint8)


def write_files(folder: Path) -> None:
    """Write all inputs of command lines into a folder, which becomes the current one when they run."""
    write_pictures(folder)
    write_deep_pictures(folder)
    write_layers(folder)
    write_folders(folder)
    write_film(folder / "film.mp4")
    for name, content in recipes().items():
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / name).write_text(text, encoding="utf-8")


def write_pictures(folder: Path) -> None:
    """Write pictures of 8 bits."""
    cat, cup = photograph("chelsea"), photograph("coffee")
    ramp = np.linspace(0, 255, cup.shape[1]).astype(np.uint8)
    files = {
        "photo.png": cat,
        "grey.png": photograph("camera"),
        "noisy.png": noisy(cat, 12),
        "clear.png": np.dstack([cup, np.broadcast_to(ramp, SIZE)]),
        "edited.png": brightened(cat),
        "part.png": brightened(cat)[6:66, 8:88],
        "other.png": photograph("astronaut"),
        "scan.png": photograph("chelsea", 0, 0, SCAN),
    }
    for name, pixels in files.items():
        Image.fromarray(pixels).save(folder / name, dpi=(300, 300))
    exif = Image.Exif()
    exif.update(EXIF)
    Image.fromarray(cup).save(
        folder / "photo.jpg", quality=95, exif=exif, icc_profile=profile(), dpi=(72, 72), xmp=XMP, subsampling=0
    )
    Image.fromarray(cup).save(folder / "photo.webp", lossless=True, exif=exif, icc_profile=profile())
    (folder / "empty.png").touch()
    (folder / "half.png").write_bytes((folder / "photo.png").read_bytes()[:3000])
    (folder / "text.jpg").write_text("no picture")


def write_deep_pictures(folder: Path) -> None:
    """Write pictures of 16 bits and of floats, TIFF files and arrays of zarr."""
    cat, scan = photograph("chelsea"), photograph("chelsea", 0, 0, SCAN)
    deep = (cat.astype(np.uint16) * 257) ^ 5
    floats = (cat / 255).astype(np.float32) * 1.5 - 0.1
    (folder / "deep.png").write_bytes(imagecodecs.png_encode(deep))
    tags = [(34675, "B", None, profile(), True)]  # the colour profile
    usual: dict[str, Any] = {"photometric": "rgb", "metadata": None}
    tifffile.imwrite(folder / "photo.tif", cat, extratags=tags, resolution=(300, 300), description="A cat", **usual)
    tifffile.imwrite(folder / "deep.tif", deep, compression="deflate", predictor=True, **usual)
    tifffile.imwrite(folder / "float.tif", floats, **usual)
    holed = floats.copy()
    holed[3, 5] = np.nan
    tifffile.imwrite(folder / "holed.tif", holed, **usual)
    tifffile.imwrite(folder / "scan.tif", scan, tile=(64, 64), compression="deflate", extratags=tags, **usual)
    grey = photograph("camera", 0, 0, SCAN)
    tifffile.imwrite(folder / "scan-grey.tif", grey, rowsperstrip=16, photometric="minisblack", metadata=None)
    for name, pixels in (("photo.zarr", cat), ("scan.zarr", scan), ("deep.zarr", deep)):
        zarr.create_array(store=folder / name, data=np.ascontiguousarray(pixels), chunks=(32, 32, 3))


def write_layers(folder: Path) -> None:
    """Write layers of strokes and masks, of the size of photographs and of scans."""
    for prefix, size in (("", SIZE), ("scan-", SCAN)):
        strokes = np.zeros((*size, 4), np.uint8)
        strokes[10:16, 12:30], strokes[50:56, 60:80] = (200, 40, 30, 255), (20, 90, 200, 255)
        mask = np.zeros(size, np.uint8)
        mask[20:44, 30:60] = 255
        Image.fromarray(strokes).save(folder / f"{prefix}strokes.png")
        Image.fromarray(mask).save(folder / f"{prefix}mask.png")
        Image.fromarray(255 - mask).save(folder / f"{prefix}rest.png")


def write_folders(folder: Path) -> None:
    """Write folders: of frames of a pan, and of pairs before and after an edit."""
    for name in ("shots", "before", "after"):
        (folder / name).mkdir()
    for number in range(3):
        frame = photograph("astronaut", 60 + 6 * number, 130 + 6 * number, (60, 72))
        Image.fromarray(frame).save(folder / "shots" / f"{number}.png")
    for name in ("chelsea", "coffee", "astronaut"):
        Image.fromarray(photograph(name)).save(folder / "before" / f"{name}.png")
        Image.fromarray(brightened(photograph(name))).save(folder / "after" / f"{name}.png")


def write_film(path: Path) -> None:
    """Write a film of four frames of a pan."""
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=25, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 72, 60, "yuv420p"
        stream.codec_context.thread_count = 1
        for number in range(4):
            pixels = photograph("astronaut", 60 + 6 * number, 130 + 6 * number, (60, 72))
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")))
        film.mux(stream.encode())


def stroke(paint: str, points: list[list[float]], radius: float = 0.05) -> Entries:
    """A stroke as an entry of a recipe."""
    return {"paint": paint, "radius": radius, "points": points}


def steps() -> list[Entries]:
    """A step of every edit, those that take strokes with strokes."""
    blue, red, keep = stroke("#2050c0", LEFT), stroke("#c04020", RIGHT), stroke("out", [[0.5, 0.1]])
    inside, outside = stroke("in", LEFT), stroke("out", RIGHT, 0.1)
    return [
        {"edit": "denoise", "strength": 0.7, "noise_level": 4.0},
        {"edit": "detail", "alpha": [2, 1.5, 1, 1], "inside": [0, 1, 3, 1], "strokes": [inside, outside]},
        {"edit": "tone", "contrast": 1.1, "clarity": 1.5},
        {"edit": "sharpen", "amount": 2.5},
        {"edit": "colorize", "strength": 0.5, "strokes": [blue, red]},
        {"edit": "recolor", "reach": 0.7, "strokes": [blue, keep]},
        {"edit": "defocus", "radius": 3.0, "strokes": [inside, outside]},
        {"edit": "abstract", "edges": 0.5, "tones": 12},
        {
            "edit": "look",
            "amount": 0.7,
            "matrix": [0.9, 0.1, 0, 0, 1, 0, 0, 0.2, 0.8],
            "bands": [1.2, 1, 1, 1, 1, 1, 1],
        },
    ]


def recipes() -> dict[str, Entries | str]:
    """Recipes by the names of their files, right and wrong ones."""
    every = [step for step in steps() if step["edit"] not in ("colorize", "recolor")]
    few = [step for step in every if step["edit"] != "abstract"]
    by_edit = {f"{step['edit']}.json": {"version": 1, "steps": [step]} for step in steps()}
    detail = {"edit": "detail", "alpha": [3.0, 1.0], "landmarks": 40}
    former = {"detail": {"alpha": [3.0, 1.0]}, "abstract": {"power": 0.2}}
    right: dict[str, Entries | str] = {
        **by_edit,
        "every.json": {"version": 1, "steps": every},
        "few.json": {"version": 1, "steps": few},
        "plain.json": {"version": 1, "steps": [detail, {"edit": "tone"}]},
        "single.json": {"version": 1, "steps": [detail]},
        "idle.json": {"version": 1, "steps": []},
        "former.json": former,
    }
    beside = stroke("in", [[9.0, 0.5]])
    wrong: dict[str, Entries | str] = {
        "no-json.json": "alpha = 1",
        "list.json": "[1, 2]",
        "newer.json": {"version": 99, "steps": []},
        "no-edit.json": {"version": 1, "steps": [{"edit": "embellish"}]},
        "entry.json": {"version": 1, "steps": [{"edit": "tone", "colour": 1}]},
        "value.json": {"version": 1, "steps": [{"edit": "tone", "contrast": "much"}]},
        "range.json": {"version": 1, "steps": [{"edit": "denoise", "strength": 7}]},
        "far.json": {"version": 1, "steps": [{"edit": "defocus", "strokes": [beside]}]},
        "paint.json": {"version": 1, "steps": [{"edit": "recolor", "strokes": [stroke("in", LEFT)]}]},
        "inside.json": {"version": 1, "steps": [{"edit": "detail", "inside": [1, 2], "strokes": [stroke("in", LEFT)]}]},
    }
    return right | wrong


def image(name: str, dtype: torch.dtype, step: int = 3) -> Tensor:
    """A reduced photograph (1, 1 or 3, 24, 32) in [0, 1]."""
    pixels = torch.from_numpy(np.atleast_3d(photograph(name)[::step, ::step]).copy())
    return pixels.permute(2, 0, 1)[None].to(dtype) / 255


def box(top: int, left: int, dtype: torch.dtype, side: int = 5) -> Tensor:
    """A mask (1, 1, 24, 32) that is 1 in a square."""
    mask = torch.zeros(1, 1, 24, 32, dtype=dtype)
    mask[..., top : top + side, left : left + side] = 1
    return mask


def seeded(seed: int = 0) -> torch.Generator:
    """A random generator."""
    return torch.Generator().manual_seed(seed)
