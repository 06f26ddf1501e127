"""JPEG: metadata, what follows the picture, strips, and damage."""

import io
import re
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from PIL import Image

from nlfilter_torch.photo.files import rows
from nlfilter_torch.photo.files.formats import fitting_jpeg
from nlfilter_torch.photo.files.jpeg import open_jpeg, write_jpeg
from nlfilter_torch.photo.files.metadata import Extras, Header, Metadata
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph
from tests.files import cat, rows_of
from tests.pairwise import each_value

GAIN_MAP = b'<x:xmpmeta><rdf:Description hdrgm:Version="1.0" GCamera:MotionPhoto="1" xmp:Rating="4"/></x:xmpmeta>'


def encoded(**options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(cat()).save(stream, "JPEG", **options)
    return stream.getvalue()


def test_what_is_gone_is_not_stated_but_named(tmp_path: Path) -> None:
    (tmp_path / "in.jpg").write_bytes(encoded(xmp=GAIN_MAP, comment=b"hello") + encoded() + b"\0\0\0\x18ftypmp42")
    opened = read_photograph(tmp_path / "in.jpg")
    with pytest.warns(UserWarning, match="without .*: a gain map, the video of a motion photo, further pictures$"):
        write_photograph(opened, tmp_path / "out.jpg")
    written = (tmp_path / "out.jpg").read_bytes()
    assert b"hdrgm" not in written
    assert b"MotionPhoto" not in written
    assert b'xmp:Rating="4"' in written
    assert written.count(b"\xff\xd8\xff") == 1
    with Image.open(tmp_path / "out.jpg") as image:
        assert image.info["comment"] == b"hello"
    with pytest.warns(UserWarning, match="without .*, the comment$"):
        write_photograph(opened, tmp_path / "out.png")


def test_the_second_picture_of_an_mpo_is_named(tmp_path: Path) -> None:
    Image.fromarray(cat()).save(
        tmp_path / "in.jpg", format="MPO", save_all=True, append_images=[Image.new("RGB", (9, 9))]
    )
    with pytest.warns(UserWarning, match="without .*: further pictures$"):
        write_photograph(read_photograph(tmp_path / "in.jpg"), tmp_path / "out.jpg")
    with Image.open(tmp_path / "out.jpg") as image:
        assert image.format == "JPEG"


@pytest.mark.parametrize(("channels", "height"), each_value([1, 3], [1, 8, 64, 65, 200, 700]))
def test_strips_are_one_picture(height: int, channels: int) -> None:
    picture = np.tile(cat(channels=channels), (4, 1, 1))[:height]
    stream = io.BytesIO()
    write_jpeg(
        stream,
        (picture[top : top + 37] for top in range(0, height, 37)),
        Header(picture.shape, np.dtype("uint8"), False, Metadata()),
    )
    whole = imagecodecs.jpeg8_encode(picture[..., 0] if channels == 1 else picture, level=95, subsampling="444")
    np.testing.assert_array_equal(imagecodecs.jpeg8_decode(stream.getvalue()), imagecodecs.jpeg8_decode(whole))
    assert np.asarray(Image.open(stream)).shape[0] == height


@pytest.mark.parametrize("dpi", [(72, 72), (240, 300), (299.72, 299.72)])
def test_the_density_is_in_the_unit_that_holds_it(dpi: tuple[float, float]) -> None:
    stream = io.BytesIO()
    write_jpeg(stream, [cat()], Header(cat().shape, np.dtype("uint8"), False, Metadata(extras=Extras(dpi=dpi))))
    assert open_jpeg(Path(), stream.getvalue()).metadata.extras.dpi == pytest.approx(dpi, abs=0.001)


def test_a_density_that_is_rounded_is_named() -> None:
    """But for what PNG files hold in place of whole numbers."""
    named = {(240.4, 300.0): "240 x 300", (9449 / 100 * 2.54, 7.62): "240 x 8"}
    for dpi, stored in named.items():
        (sentence,) = fitting_jpeg(Metadata(extras=Extras(dpi=dpi)))[1]
        assert re.fullmatch(rf"the print resolution of .* dpi, of which JPEG holds {stored}", sentence)
    for near in ((9449 * 0.0254, 11811 * 0.0254), (72.0, 72.0), (100 * 2.54, 50 * 2.54)):
        assert fitting_jpeg(Metadata(extras=Extras(dpi=near)))[1] == []


def test_profiles_in_several_segments(tmp_path: Path) -> None:
    profile = np.random.default_rng(0).bytes(200_000)
    stream = io.BytesIO()
    write_jpeg(stream, [cat()], Header(cat().shape, np.dtype("uint8"), False, Metadata(icc=profile)))
    assert open_jpeg(Path(), stream.getvalue()).metadata.icc == profile
    assert Image.open(stream).info["icc_profile"] == profile
    with pytest.raises(EOFError):
        open_jpeg(Path(), stream.getvalue()[:3000]).decode_into(
            stream.getvalue()[:3000], np.empty((200, 150, 3), np.uint8)
        )


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5000, 1), (3000, 1, 3), (70, 9000, 3)])
def test_noise_of_every_shape_is_written(shape: tuple[int, int, int]) -> None:
    values = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    stream = io.BytesIO()
    write_jpeg(stream, [values], Header(shape, np.dtype("uint8"), False, Metadata()))
    assert np.asarray(imagecodecs.jpeg8_decode(stream.getvalue())).size == values.size


def test_a_file_without_an_end_is_read_if_no_row_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In memory and in tiles alike."""
    whole, path = encoded(), tmp_path / "in.jpg"
    path.write_bytes(whole)
    wanted = rows_of(path)
    for limit in (rows.TILED_MEMORY, 1000):
        monkeypatch.setattr(rows, "TILED_MEMORY", limit)
        path.write_bytes(whole[:-2] + bytes(4000))
        with pytest.warns(UserWarning, match=r"in\.jpg has no end, so its last rows may be damaged: look at them, or"):
            np.testing.assert_array_equal(rows_of(path), wanted)
        path.write_bytes(whole[: len(whole) * 2 // 3])
        with pytest.raises(ValueError, match=r"in\.jpg is damaged or cut short"):
            rows_of(path)
