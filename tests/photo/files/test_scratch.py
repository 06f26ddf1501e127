"""Large PNG and JPEG files are decoded into a temporary file, and read by rows."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nlfilter_torch.photo.files import rows, scratch
from nlfilter_torch.photo.files.exif import upright
from nlfilter_torch.photo.files.formats import read_channels
from nlfilter_torch.photo.files.rows import open_picture, upright_copy
from nlfilter_torch.photo.files.scratch import Scratch
from tests.files import PLENTY, cat, rows_of
from tests.pairwise import pairwise


@pytest.mark.parametrize("orientation", range(1, 9))
def test_copies_are_upright(orientation: int) -> None:
    with ExitStack() as stack:
        stored = Scratch((200, 150, 3), np.dtype(np.uint8), stack)
        with stored.array() as out:
            out[...] = cat()
        copy = upright_copy(stored, orientation, 37, stack)
        wanted = upright(cat(), orientation)
        assert copy.shape == wanted.shape
        np.testing.assert_array_equal(copy[slice(10, 90)], wanted[10:90])


@pytest.mark.parametrize(("channels", "suffix", "orientation"), pairwise([1, 3, 4], [".png", ".jpg"], [1, 3, 6]))
def test_large_files(
    tmp_path: Path, channels: int, suffix: str, orientation: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if suffix == ".jpg" and channels == 4:
        pytest.skip("JPEG has no alpha channel")
    exif = Image.Exif()
    exif[274], exif[271] = orientation, "Maker"
    picture = cat(channels=channels)
    path = tmp_path / f"in{suffix}"
    Image.fromarray(picture[..., 0] if channels == 1 else picture).save(path, exif=exif)
    whole = read_channels(path, bytes_per_pixel=0, memory=None)
    monkeypatch.setattr(rows, "UNPACKED", 1000)
    np.testing.assert_array_equal(rows_of(path), whole.channels)
    with open_picture(path, PLENTY) as stored:
        assert isinstance(stored.rows, Scratch)
        assert stored.metadata == whole.metadata
        assert stored.alpha == (channels == 4)
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(ValueError, match="is damaged or cut short"):
        rows_of(path)


@pytest.mark.parametrize(("name", "options"), [("in.jpg", {"progressive": True}), ("in.webp", {})])
def test_others_need_memory(
    tmp_path: Path, name: str, options: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(cat()).save(tmp_path / name, **options)
    monkeypatch.setattr(rows, "UNPACKED", 1000)
    assert rows_of(tmp_path / name).shape == (200, 150, 3)
    with pytest.raises(MemoryError, match="has 150x200 pixels and needs about 0 MB"):
        open_picture(tmp_path / name, 1000).__enter__()


def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    usage = scratch.shutil.disk_usage("/")._replace(free=1000)
    monkeypatch.setattr(scratch.shutil, "disk_usage", lambda folder: usage)
    with ExitStack() as stack, pytest.raises(MemoryError, match=r"temporary file of 3 MB .* set TMPDIR to a folder"):
        Scratch((1000, 1000, 3), np.dtype(np.uint8), stack)
