"""TIFF files of every kind become plain channels; invalid tags are ignored."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.photo.io.photographs import read_photograph
from tests.files import photograph, same, stored_values


@pytest.mark.parametrize("tag", [(274, 2, 4, "top"), (274, 5, 1, (1, 0)), (274, 3, 2, (6, 1)), (34675, 3, 1, 5)])
def test_tags_of_tiff_without_sense_are_ignored(tmp_path: Path, tag: tuple[object, ...]) -> None:
    tifffile.imwrite(tmp_path / "in.tif", stored_values(3, "uint8"), extratags=[(*tag, True)], metadata=None)
    opened = read_photograph(tmp_path / "in.tif")
    assert torch.equal(opened.pixels, photograph(stored_values(3, "uint8")).pixels)
    assert opened.icc is None


def test_stored_kinds_are_made_plain(tmp_path: Path) -> None:
    """Inverted grey, separate planes, compression, premultiplied alpha, BigTIFF, pages and JPEG."""
    bare = {"metadata": None, "software": False}  # otherwise tifffile describes the array in its own tags
    grey, rgba = stored_values(1, "uint16")[..., 0], stored_values(4, "uint16")
    tifffile.imwrite(tmp_path / "inverted.tif", grey, photometric="miniswhite", byteorder=">")
    assert torch.equal(read_photograph(tmp_path / "inverted.tif").pixels, photograph(65535 - grey[..., None]).pixels)
    planes = np.moveaxis(rgba[..., :3], -1, 0)
    tifffile.imwrite(tmp_path / "planes.tif", planes, photometric="rgb", planarconfig="separate")
    assert torch.equal(read_photograph(tmp_path / "planes.tif").pixels, photograph(rgba[..., :3]).pixels)
    for compression in ("lzw", "zlib", "lzma"):
        tifffile.imwrite(
            tmp_path / "packed.tif", rgba, photometric="rgb", extrasamples=[2], compression=compression, **bare
        )
        same(read_photograph(tmp_path / "packed.tif"), photograph(rgba))
    half = np.full((3, 4, 4), [100, 50, 0, 128], np.uint8)
    tifffile.imwrite(tmp_path / "associated.tif", half, photometric="rgb", extrasamples=["assocalpha"])
    opened = read_photograph(tmp_path / "associated.tif")
    assert (255 * opened.pixels[0, :, 0, 0]).round().tolist() == [199, 100, 0]
    floats = half.astype(np.float32) / 255
    tifffile.imwrite(tmp_path / "associated.tif", floats, photometric="rgb", extrasamples=["assocalpha"])
    torch.testing.assert_close(
        read_photograph(tmp_path / "associated.tif").pixels[0, :, 0, 0], torch.tensor([100 / 128, 50 / 128, 0])
    )
    tifffile.imwrite(tmp_path / "big.tif", rgba, photometric="rgb", extrasamples=[2], bigtiff=True, **bare)
    same(read_photograph(tmp_path / "big.tif"), photograph(rgba))
    tifffile.imwrite(tmp_path / "pages.tif", np.stack([rgba, rgba // 2]), photometric="rgb", extrasamples=[2], **bare)
    with pytest.warns(UserWarning, match="pages.tif has 2 pages, of which only the first is read; save the others"):
        same(read_photograph(tmp_path / "pages.tif"), photograph(rgba))
    rgb = Image.fromarray(np.full((16, 16, 3), 90, np.uint8))
    rgb.save(tmp_path / "jpeg.tif", compression="jpeg")
    torch.testing.assert_close(read_photograph(tmp_path / "jpeg.tif").pixels, torch.full((1, 3, 16, 16), 90 / 255))
