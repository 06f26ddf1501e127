"""Scribbles over pictures that are read by rows."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo import colorize, recolor
from nlfilter_torch.photo.picture import sampling, tiles
from nlfilter_torch.photo.picture.colour import split_luminance
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.painting import cover
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.regions import (
    num_regions,
    read_regions,
    read_scribbles,
    region_weights,
    resized_masks,
)
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes
from tests import problems
from tests.pairwise import each_value
from tests.problems import box, noise
from tests.recipes import BLUE, rows_of
from tests.streams import stream_colorize, stream_detail, stream_recolor
from tests.strokes import mask_of, paint
from tests.tiles import FEW, LEVEL, Rows, Shrinking, cat


@pytest.mark.parametrize("rows", [slice(0, 1), slice(3, 11), slice(7, 48), slice(0, 48)])
def test_strokes_cover_the_same_by_rows(rows: slice) -> None:
    strokes, size = (BLUE, replace(BLUE, points=((-0.1, 0.9), (1.2, 0.1)), paint="#ff0000")), (48, 64)
    assert torch.equal(cover(BLUE, size, rows), cover(BLUE, size)[rows])
    assert torch.equal(mask_of(strokes, size, rows), mask_of(strokes, size)[..., rows, :])
    for part, whole in zip(paint(strokes, size, rows), paint(strokes, size), strict=True):
        assert torch.equal(part, whole[..., rows, :])


def test_negative_regions_come_with_regions_of_their_number() -> None:
    source = rows_of(problems.cat())
    edited, two, three = np.empty_like(source), np.ones((100, 150, 2), np.float32), np.ones((100, 150, 3), np.float32)
    with pytest.raises(ValueError, match="negative must be given together with regions, got no regions"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), negative=two)
    with pytest.raises(ValueError, match="negative must have 1 channel or one for each of the 2 regions, got 3"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), two, negative=three)
    with pytest.raises(ValueError, match="negative must have the height and width of source, 100x150, got 99x150"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), two, negative=two[1:])
    with pytest.raises(ValueError, match="negative must hold a painted pixel, got none"):
        stream_detail(source, edited, torch.tensor([2.0, 1.0]), two, negative=0 * two)


Array = NDArray[Any]


def paint_rows(height: int, width: int) -> tuple[Array, Array, Array]:
    """Strokes (H, W, 3) of three colours, two spots of one of them, their mask (H, W, 1), and what is kept (H, W)."""
    strokes, mask = np.zeros((height, width, 3), np.float32), np.zeros((height, width, 1), np.float32)
    for top, left, colour, weight in (
        (0.25, 0.25, (0, 0, 1), 1.0),
        (0.7, 0.6, (1, 0, 0), 0.7),
        (0.1, 0.8, (0, 0.7, 0.2), 1.0),
        (0.8, 0.1, (0, 0, 1), 1.0),
    ):
        rows, columns = slice(int(top * height), int(top * height) + 8), slice(int(left * width), int(left * width) + 9)
        strokes[rows, columns], mask[rows, columns] = colour, weight
    keep = np.zeros((height, width), np.float32)
    keep[int(0.22 * height) : int(0.3 * height), int(0.3 * width) : int(0.5 * width)] = 0.8
    return strokes, mask, keep


def planes(rows: Array) -> torch.Tensor:
    """(1, C, H, W)."""
    return torch.from_numpy(np.atleast_3d(rows)).permute(2, 0, 1)[None]


def grey(picture: Array) -> Array:
    """(H, W)."""
    return split_luminance(planes(picture))[0][0, 0].numpy()


def recoloured(picture: Array, *painted: Array, **options: Any) -> Array:
    edited = np.empty_like(picture)
    stream_recolor(picture, edited, *painted, num_landmarks=options.pop("num_landmarks", 50), **options)
    return edited


def coloured(picture: Array, *painted: Array, kind: Any = None, **options: Any) -> Array:
    edited = np.empty((*picture.shape[:2], 3), kind or picture.dtype)
    stream_colorize(picture, edited, *painted, num_landmarks=options.pop("num_landmarks", 50), **options)
    return edited


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("dtype", "options", "kept"),
    [
        (dtype, options, kept)
        for dtype, (options, kept) in each_value(
            [np.float32, np.float64],
            [
                ({}, False),
                ({"reach": 0.5, "patch_size": 5, "extent": "object"}, True),
                ({"spatial_bandwidth": 60.0, "photometric_bandwidth": 0.2}, True),
                ({"landmarks": "uniform", "brightness": 0.8}, False),
            ],
        )
    ],
)
def test_full_passes_recolour_as_in_memory(
    options: dict[str, Any], kept: bool, dtype: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def balanced_well(guide: torch.Tensor, built: FilterOptions, weights: torch.Tensor | None) -> NonlocalOperator:
        """In float32, to a tolerance that does not hide differences."""
        return operator_from_guide(guide, replace(built, tolerance=1e-6 if dtype == np.float32 else None), weights)

    monkeypatch.setattr("nlfilter_torch.photo.picture.in_memory.operator_from_guide", balanced_well)
    picture = cat(83, 121).astype(dtype)
    strokes, mask, keep = paint_rows(83, 121)
    held = {"keep": planes(keep.astype(dtype))} if kept else {}
    whole = recolor(
        planes(picture),
        planes(strokes.astype(dtype)),
        planes(mask.astype(dtype)),
        num_landmarks=50,
        **held,
        **options,
    )
    background = {"keep": keep} if kept else {}
    edited = recoloured(picture, strokes, mask, statistics="full", tile_rows=17, **background, **options)
    assert np.abs(rows_of(whole) - picture).max() > 0.1
    assert np.abs(edited - rows_of(whole)).max() < (1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("dtype", "options"),
    each_value(
        [np.float32, np.float64], [{}, {"strength": 0.3, "patch_size": 3}, {"patch_size": 1, "spatial_bandwidth": 30.0}]
    ),
)
def test_full_passes_colourise_as_in_memory(options: dict[str, Any], dtype: Any) -> None:
    picture = grey(cat(83, 121)).astype(dtype)
    strokes, mask, _ = paint_rows(83, 121)

    def seeded() -> torch.Generator:
        return torch.Generator().manual_seed(3)

    painted = (planes(strokes.astype(dtype)), planes(mask.astype(dtype)))
    whole = colorize(planes(picture), *painted, num_landmarks=50, generator=seeded(), **options)
    edited = coloured(picture, strokes, mask, statistics="full", tile_rows=17, generator=seeded(), **options)
    assert np.ptp(edited, axis=2).max() > 0.1
    assert np.abs(edited - rows_of(whole)).max() < (1e-5 if dtype == np.float32 else 1e-7)


def test_a_sample_is_within_a_grey_level(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "PILOT", 1 << 12)
    picture = cat(270, 350)
    strokes, mask, keep = paint_rows(270, 350)
    whole = recolor(planes(picture), planes(strokes), planes(mask), keep=planes(keep), num_landmarks=50)
    edited = recoloured(picture, strokes, mask, keep=keep, sample=1 << 12)
    assert np.abs(edited - rows_of(whole)).max() < 1e-5  # takes sums over all pixels of a reduced picture
    whole = colorize(planes(grey(picture)), planes(strokes), planes(mask), num_landmarks=50)
    edited = coloured(picture, strokes, mask, sample=1 << 12)
    assert 1e-5 < np.abs(edited - rows_of(whole)).max() < LEVEL


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("statistics", ["sample", "full"])
def test_tiles_of_any_size_give_the_same(statistics: Any) -> None:
    picture = cat(150, 67)
    strokes, mask, keep = paint_rows(150, 67)
    settings = {"statistics": statistics, "sample": 4000}
    first, *others = (
        (
            recoloured(picture, strokes, mask, keep=keep, tile_rows=rows, **settings),
            coloured(grey(picture), strokes, mask, tile_rows=rows, **settings),
        )
        for rows in (1, 16, 64, 4096)
    )
    for other in others:
        assert max(np.abs(a - b).max() for a, b in zip(first, other, strict=True)) < 1e-6


def test_a_guide_that_is_kept_changes_nothing() -> None:
    picture, (strokes, mask, _) = cat(90, 60), paint_rows(90, 60)
    kept, made_again = (
        recoloured(picture, strokes, mask, num_landmarks=20, tile_rows=16),
        recoloured(picture, strokes, mask, num_landmarks=20, tile_rows=16, memory=tiles.LARGE_MEMORY - 1),
    )
    np.testing.assert_allclose(kept, made_again, atol=1e-4)


def test_everything_is_read_a_few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 600)
    picture = cat(240, 60)
    painted = paint_rows(240, 60)
    settings = {"tile_rows": 10, "sample": 2000, "num_landmarks": 30, "memory": FEW}
    source, *paints = (Rows(rows, most=10 + 2 * 40) for rows in (picture, *painted))  # with surroundings
    edited = np.empty_like(picture)
    stream_recolor(source, edited, paints[0], paints[1], keep=paints[2], **settings)
    np.testing.assert_array_equal(edited, recoloured(picture, *painted[:2], keep=painted[2], **settings))
    assert paints[0].read < 200  # where there is paint
    assert paints[1].read == paints[2].read == 240  # once
    stream_colorize(source, edited, paints[0], paints[1], **settings)
    np.testing.assert_array_equal(edited, coloured(picture, *painted[:2], **settings))


def test_strokes_may_be_integers_with_transparency() -> None:
    picture, (strokes, mask, keep) = cat(50, 60), paint_rows(50, 60)
    layer = np.concatenate([np.rint(strokes * 255), np.rint(mask * 255)], axis=2).astype(np.uint8)
    opaque = layer[..., 3:] / np.float32(255)
    for edit in (recoloured, coloured):
        edited = edit(picture, layer)
        np.testing.assert_array_equal(edited, edit(picture, layer[..., :3], opaque))
        np.testing.assert_array_equal(edited, edit(picture, layer[..., :3] / np.float32(255), layer[..., 3]))
    np.testing.assert_array_equal(
        recoloured(picture, layer, keep=keep > 0), recoloured(picture, layer, keep=np.ceil(keep))
    )


def test_nothing_is_kept_by_an_empty_mask() -> None:
    picture, (strokes, mask, keep) = cat(50, 60), paint_rows(50, 60)
    none = recoloured(picture, strokes, mask, keep=0 * keep)
    np.testing.assert_allclose(none, recoloured(picture, strokes, mask), atol=1e-5)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_transparency_and_depth_are_kept(channels: int) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (40, 50, channels), np.uint8)
    strokes, mask, _ = paint_rows(40, 50)
    edited = np.empty((40, 50, 3 + (channels in (2, 4))), np.uint16)
    stream_colorize(picture, edited, strokes, mask, num_landmarks=20)
    if channels in (2, 4):
        np.testing.assert_array_equal(edited[..., 3], picture[..., -1].astype(np.uint16) * 257)
    if channels > 2:
        again = np.empty_like(picture)
        stream_recolor(picture, again, strokes, mask, num_landmarks=20)
        np.testing.assert_array_equal(again[..., 3:], picture[..., 3:])


def test_report_tells_every_stage() -> None:
    seen: list[str] = []
    picture, (strokes, mask, _) = cat(40, 60), paint_rows(40, 60)
    recoloured(picture, strokes, mask, sample=1000, num_landmarks=20, report=lambda *step: seen.append(step[0]))
    assert list(dict.fromkeys(seen)) == ["Reading strokes", "Reducing", "Filtering"]
    seen.clear()
    coloured(grey(picture), strokes, mask, sample=1000, num_landmarks=20, report=lambda *step: seen.append(step[0]))
    stages = ["Reading strokes", "Reducing", "Looking", "Comparing strokes", "Sampling", "Balancing", "Bounding"]
    assert list(dict.fromkeys(seen))[: len(stages)] == stages


def test_painted_pixels_need_memory() -> None:
    picture, (strokes, mask, _) = cat(180, 240), paint_rows(180, 240)
    with pytest.raises(MemoryError, match=r"the strokes on source cover at least \d+ pixels .* paint less"):
        read_scribbles(
            Picture(picture),
            0 * mask + 1,
            strokes,
            name="stroke_mask",
            strokes="strokes",
            memory=500_000,
            report=lambda *_: None,
        )
    for edit, reason in ((recoloured, "source needs"), (coloured, "the strokes on source cover")):
        with pytest.raises(MemoryError, match=reason):
            edit(picture, strokes, 0 * mask + 1, memory=7_000_000, num_landmarks=5)
        with pytest.raises(MemoryError, match=r"source needs at least \d+ MB of memory, but"):
            edit(picture, strokes, mask, memory=1_000_000)


REFUSED = [
    (lambda s, m: (s[1:], m), {}, "strokes must have the height and width of source, 40x50, got 39x50; resize"),
    (lambda s, m: (s, m[:, 1:]), {}, "stroke_mask must have the height and width of source, 40x50, got 40x49"),
    (lambda s, m: (s, 0 * m), {}, "stroke_mask must hold a painted pixel, got none; paint at least one"),
    (lambda s, m: (np.concatenate([s, 0 * m], axis=2),), {}, "strokes must hold a painted pixel, got none"),
    (lambda s, m: (s, 2 * m), {}, r"stroke_mask must be in \[0, 1\], got values from 0 to 2; clamp or scale it"),
    (lambda s, m: (s, -m), {}, r"stroke_mask must be in \[0, 1\], got values from -1 to"),
    (lambda s, m: (s, np.where(m > 0, np.nan, m)), {}, "stroke_mask holds NaN or infinite pixels"),
    (lambda s, m: (np.where(m > 0, np.nan, s), m), {}, "strokes holds NaN or infinite pixels"),
    (
        lambda s, m: (s,),
        {},
        "strokes must have 3 channels with a stroke_mask, or 4 channels without one, got 3 channels without",
    ),
    (lambda s, m: (np.concatenate([s, m], axis=2), m), {}, "got 4 channels with a stroke_mask; add or drop it"),
    (lambda s, m: (s, s), {}, "stroke_mask must have 1 channel, got 3"),
    (lambda s, m: (Shrinking(s, most=100, read=50), m), {}, "strokes must keep its size while it is read"),
    (lambda s, m: (s, m), {"statistics": "some"}, "statistics must be one of"),
    (lambda s, m: (s, m), {"sample": 0}, "sample must be at least 1"),
    (lambda s, m: (s, m), {"tile_rows": 0}, "tile_rows must be at least 1"),
    (lambda s, m: (s, m), {"patch_size": 4}, "patch_size must be odd"),
    (lambda s, m: (s, m), {"num_landmarks": 0}, "num_landmarks must be at least 1"),
    (lambda s, m: (s, m), {"photometric_bandwidth": 0.0}, "photometric_bandwidth must be positive"),
    (lambda s, m: (s, m), {"spatial_bandwidth": 0.0}, "spatial_bandwidth must be positive"),
]


@pytest.mark.parametrize("edit", [recoloured, coloured])
def test_what_cannot_be_used_is_named(edit: Any) -> None:
    for change, options, message in REFUSED:
        strokes, mask, _ = paint_rows(40, 50)
        with pytest.raises(ValueError, match=message):
            edit(cat(40, 50), *change(strokes, mask), **options)


def test_what_only_one_of_them_takes_is_named() -> None:
    picture, (strokes, mask, keep) = cat(40, 50), paint_rows(40, 50)
    with pytest.raises(
        ValueError, match="recolor needs a colour photograph, got a grey one; use colorize for grey photographs"
    ):
        recoloured(grey(picture), strokes, mask)
    with pytest.raises(ValueError, match="keep must have the height and width of source"):
        recoloured(picture, strokes, mask, keep=keep[1:])
    with pytest.raises(ValueError, match=r"reach must be in \[0, 1\), got 1"):
        recoloured(picture, strokes, mask, reach=1.0)
    with pytest.raises(ValueError, match="target must have the shape of the source"):
        stream_recolor(picture, grey(picture), strokes, mask)
    with pytest.raises(ValueError, match=r"strength must be in \[0, 1\]"):
        coloured(picture, strokes, mask, strength=2.0)
    with pytest.raises(ValueError, match="method must be regression for a picture processed in tiles, got kmeans"):
        coloured(picture, strokes, mask, method="kmeans")
    with pytest.raises(ValueError, match="target must have the height and width of the source, three colours"):
        stream_colorize(picture, grey(picture), strokes, mask)
    with pytest.raises(ValueError, match="dtype of the target must be one of"):
        coloured(picture, strokes, mask, kind=np.int64)


def test_a_source_that_changes_its_size_is_named() -> None:
    strokes, mask, _ = paint_rows(40, 30)
    for edit in (stream_recolor, stream_colorize):
        source = Shrinking(cat(40, 30), most=100)
        with pytest.raises(ValueError, match="source must keep its size while it is read, 40 rows of 30"):
            edit(source, np.empty_like(source.picture), strokes, mask, num_landmarks=20, tile_rows=10)


REGIONS = torch.cat([box(2, 3, size=(12, 15)), 0.5 * box(6, 8, size=(12, 15))], dim=1).float()
REGION_ROWS = REGIONS[0].permute(1, 2, 0).numpy()


def both() -> tuple[InMemory, Tiled]:
    image = noise(1, 3, 12, 15).float()
    return InMemory(image), Tiled(Picture(image[0].permute(1, 2, 0).numpy()), Passes("float32"))


def test_masks_of_tiles_are_those_of_the_whole() -> None:
    whole, tiled = both()
    assert num_regions(whole, REGIONS, "regions") == num_regions(tiled, REGION_ROWS, "regions") == 2
    assert num_regions(tiled, REGION_ROWS[..., 0], "regions") == 1
    for one, other in zip(
        read_regions(whole, REGIONS, "regions"), read_regions(tiled, REGION_ROWS, "regions"), strict=True
    ):
        assert torch.equal(one.places, other.places)
        assert torch.equal(one.weights, other.weights)
        torch.testing.assert_close(one.image, other.image)
    assert len(read_regions(tiled, REGION_ROWS[..., 0], "regions")) == 1
    assert torch.equal(region_weights(whole, REGIONS, "regions")(whole), REGIONS)
    assert torch.equal(region_weights(tiled, REGION_ROWS, "regions")(whole), REGIONS)


def test_smaller_masks_stay_in_their_range() -> None:
    whole, tiled = both()
    resized = resized_masks(whole, REGIONS, (4, 5), "regions")
    assert resized.shape == (1, 2, 4, 5)
    assert resized.min() >= 0
    assert resized.max() <= 1
    rows = np.asarray(resized_masks(tiled, REGION_ROWS, (4, 5), "regions"))
    torch.testing.assert_close(torch.from_numpy(rows).permute(2, 0, 1)[None], resized)
    with pytest.raises(ValueError, match="regions must have the height and width of the image"):
        resized_masks(whole, REGIONS[..., :9], (4, 5), "regions")
    with pytest.raises(ValueError, match="regions must have the height and width of the picture"):
        resized_masks(tiled, REGION_ROWS[:, :9], (4, 5), "regions")
    with pytest.raises(ValueError, match="regions must have the height and width of the image"):
        region_weights(whole, REGIONS[..., :9], "regions")
    with pytest.raises(ValueError, match="regions must have the height and width of source, 12x15, got 12x9"):
        region_weights(tiled, REGION_ROWS[:, :9], "regions")
