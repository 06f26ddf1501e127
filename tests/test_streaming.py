"""Pictures read by rows: the result in memory, for any tiles, and errors that name their cause."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import skimage.data
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch import nonlocal_operator, polynomial_filter, region_mask
from nlfilter_torch.filtering.filters import filter_regions
from nlfilter_torch.operator import landmarks as landmarks_module
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.landmarks import candidate_pixels
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.picture.source import Guide
from nlfilter_torch.photo.tiled import sampling, stream_detail
from nlfilter_torch.photo.tiled.pictures import Picture
from nlfilter_torch.photo.tiled.sampling import ColumnCache, Draws, GuidePicture, PassOverPicture, draw
from nlfilter_torch.photo.tiled.source import Tiled
from nlfilter_torch.photo.tiled.statistics import Block, Guess, balance_by_passes
from nlfilter_torch.photo.tiled.tiles import Passes

Array = NDArray[Any]
ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05])
LEVEL = 1 / 255
PLAIN: dict[str, Any] = {  # the filter as it is, as by nonlocal_operator
    "limits": "none",
    "threshold": 0.0,
    "photometric_bandwidth": "auto",
    "spatial_bandwidth": "none",
    "num_landmarks": 100,
}
FEW = 1 << 27  # bytes that allow one row at a time


def cat(height: int, width: int) -> Array:
    """(height, width, 3) of a photograph with fur, floats in [0, 1]."""
    return skimage.data.chelsea()[20 : 20 + height, 90 : 90 + width].astype(np.float32) / np.float32(255)


def in_memory(picture: Array, alpha: Tensor = ALPHA, residual: float | None = None, **options: Any) -> Array:
    """Return the result of `nlfilter-torch detail` for a picture in memory."""
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    operator = nonlocal_operator(image, **{"tolerance": 1e-6, **options})
    edited = edit_luminance(image, lambda planes: polynomial_filter(operator, planes, alpha, residual=residual))
    return edited[0].permute(1, 2, 0).numpy()


def streamed(picture: Array, alpha: Tensor = ALPHA, *, kind: str | None = None, **options: Any) -> Array:
    edited = np.empty(picture.shape, kind or picture.dtype)
    stream_detail(picture, edited, alpha, **(PLAIN | options))
    return edited


@dataclass
class Rows:
    """A source that counts the rows read, and allows only a few rows at once."""

    picture: Array
    most: int
    read: int = 0
    shape: tuple[int, ...] = field(init=False)
    dtype: Any = field(init=False)

    def __post_init__(self) -> None:
        self.shape, self.dtype = self.picture.shape, self.picture.dtype

    def __getitem__(self, rows: slice) -> Array:
        assert rows.stop - rows.start <= self.most
        self.read += rows.stop - rows.start
        return self.picture[rows]


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce samples and blocks in proportion to a small picture."""
    monkeypatch.setattr(sampling, "PILOT", 2000)
    monkeypatch.setattr(sampling, "CHUNK", 1500)
    monkeypatch.setattr("nlfilter_torch.photo.tiled.pictures.STATISTICS_PIXELS", 2500)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"residual": 1.0},
        {"spatial_bandwidth": 30.0},
        {"landmarks": "uniform"},
        {"landmarks": "random", "patch_size": 1},
        {"guide_channels": "all", "photometric_bandwidth": 0.1, "patch_size": 3},
        {"completion": "none"},
        {"alpha": torch.tensor([2.0, 1.0])},
        {"alpha": torch.tensor([1.5, 2.0, 0.5, 2.0, 1.0, 1.0])},
    ],
)
def test_full_passes_are_the_filter_in_memory(options: dict[str, Any]) -> None:
    picture = cat(83, 121)
    edited = streamed(picture, statistics="full", tile_rows=7, num_landmarks=50, **options)
    # The part captured by the eigenvectors involves division by small eigenvalues, which amplifies rounding.
    bound = 1e-5 if "residual" not in options else 5e-5
    assert np.abs(edited - in_memory(picture, num_landmarks=50, **options)).max() < bound


def test_float64_is_worked_out_in_float64() -> None:
    picture = cat(40, 50).astype(np.float64)
    edited = streamed(picture, statistics="full", num_landmarks=40)
    assert np.abs(edited - in_memory(picture, num_landmarks=40, tolerance=1e-12)).max() < 1e-7


def test_all_channels_on_request() -> None:
    picture = cat(50, 60)
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    operator = nonlocal_operator(image, num_landmarks=40)
    wanted = polynomial_filter(operator, image, ALPHA)[0].permute(1, 2, 0).numpy()
    edited = streamed(picture, statistics="full", channels="all", num_landmarks=40)
    assert np.abs(edited - wanted).max() < 1e-5


def test_sample_is_within_a_grey_level(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "PILOT", 1 << 12)
    picture = cat(270, 350)
    edited = streamed(picture, sample=1 << 13)
    difference = np.abs(edited - in_memory(picture)).max()
    assert 1e-5 < difference < LEVEL


def spots(height: int, width: int) -> Array:
    """Two regions (height, width, 2), one of them of half weight."""
    regions = np.zeros((height, width, 2), np.float32)
    regions[10:20, 15:30, 0] = 1
    regions[30:40, 60:70, 1] = 0.5
    return regions


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("alpha", [ALPHA, torch.stack([ALPHA, torch.tensor([0.2, 0.5, 1.0, 1.0])])])
def test_regions_are_those_in_memory(alpha: Tensor) -> None:
    picture, regions = cat(60, 90), spots(60, 90)
    image = torch.from_numpy(picture).permute(2, 0, 1)[None]
    options: dict[str, Any] = {"num_landmarks": 50, "spatial_bandwidth": 60.0}
    masks = region_mask(image, torch.from_numpy(regions).permute(2, 0, 1)[None], reach=0.7, num_landmarks=50)
    operator = nonlocal_operator(reduce_channels(image, "luminance"), **options)
    wanted = edit_luminance(image, lambda planes: filter_regions(operator, planes, masks, alpha.expand(2, -1)))
    edited = streamed(picture, alpha, regions=regions, reach=0.7, statistics="full", tile_rows=17, **options)
    assert np.abs(edited - wanted[0].permute(1, 2, 0).numpy()).max() < 2e-5


def test_regions_of_a_sample_are_close(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "PILOT", 1 << 13)
    picture, regions = cat(200, 260), spots(200, 260)
    full, some = (
        streamed(picture, regions=regions, statistics=statistics, sample=1 << 15, num_landmarks=30)
        for statistics in ("full", "sample")
    )
    assert 0 < np.abs(full - some).max() < 3 * LEVEL  # with a thirtieth of the sample of a large picture
    assert np.abs(full - picture).max() > 10 * LEVEL


@pytest.mark.parametrize(
    ("regions", "alpha", "message"),
    [
        (np.ones((20, 31, 1), np.float32), ALPHA, "regions must"),
        (np.zeros((20, 30, 1), np.float32), ALPHA, "must hold a painted pixel, got none"),
        (-np.ones((20, 30, 1), np.float32), ALPHA, "regions must"),
        (np.ones((20, 30, 2), np.float32), ALPHA[None], r"alpha must have shape \(2, k\+1\), a row of sliders"),
    ],
)
def test_regions_that_cannot_be_used_are_named(regions: Array, alpha: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        streamed(cat(20, 30), alpha, regions=regions, num_landmarks=20)


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("completion", ["diagonal", "none"])
def test_sample_holds_about_as_many_pixels_as_asked_for_and_stands_for_all(completion: Any) -> None:
    picture = GuidePicture(Picture(cat(90, 120)), Guide({}))
    pilot = sampling.take_pilot(picture, silent, num_landmarks=30, completion=completion)
    guess = Guess(pilot.moment, torch.zeros(1, 0, 30, 1), lambda block, _: block.image, spectral=True)
    draw_from, moment, grams = Draws(pilot, guess.columns(pilot.sample), 3000, picture.pixels), 0.0, 0.0
    drawn = []
    for block in PassOverPicture(picture, pilot.kernel, silent, "Sampling", 2, ColumnCache(2400, 5000))(
        lambda block: block
    ):
        columns, totals = guess.totals(block)
        drawn.append(draw_from(block, columns))
        moment, grams = moment + totals.moment, grams + totals.grams
    assert len(drawn) > 1
    sample = Block.concatenate(drawn)
    assert 2500 < sample.weights.numel() < 3500
    assert abs(float(sample.weights.sum()) / picture.pixels - 1) < 0.1
    estimate = guess.totals(sample)[1]
    assert (estimate.moment - moment).norm() < 0.02 * torch.as_tensor(moment).norm()
    assert (estimate.grams - grams).norm() < 0.02 * torch.as_tensor(grams).norm()


def test_draws_follow_the_rates_and_leave_no_gap() -> None:
    generator = np.random.default_rng(0)
    rates = torch.from_numpy(generator.random(500).clip(0.01)) * 0.9
    rates[::50] = 1.0
    drawn, rounds = torch.zeros(500), 4000
    for _ in range(rounds):
        chosen, counts = draw(rates, generator)
        assert (chosen.diff() > 0).all()
        assert counts.max() <= 2
        assert abs(int(counts.sum()) - float(rates.sum())) <= 1
        drawn[chosen] += counts
    assert (drawn[::50] == rounds).all()
    # Six standard deviations of a count whose variance is at most that of independent draws.
    assert ((drawn / rounds - rates).abs() < 6 * (rates / rounds).sqrt()).all()


def test_draws_meet_no_period() -> None:
    rates, ways = torch.full((4000,), 0.25, dtype=torch.float64), np.random.default_rng(0)
    even = [int((draw(rates, ways)[0] % 4 == 1).sum()) for _ in range(20)]  # a texture of four pixels
    assert max(abs(count - 250) for count in even) < 100


def test_a_residual_takes_every_pixel() -> None:
    picture = cat(60, 80)
    edited, full = (
        streamed(picture, residual=1.0, statistics=statistics, sample=1500, num_landmarks=30)
        for statistics in ("sample", "full")
    )
    np.testing.assert_array_equal(edited, full)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("statistics", ["sample", "full"])
def test_tiles_of_any_size_give_the_same(statistics: str) -> None:
    picture = cat(150, 67)
    for options in ({}, {"regions": spots(150, 67)}):
        first, *others = (
            streamed(picture, statistics=statistics, sample=4000, num_landmarks=50, tile_rows=rows, **options)
            for rows in (1, 16, 4096)
        )
        assert max(np.abs(other - first).max() for other in others) < 2.5e-7  # of the colour conversion alone


def test_source_is_read_a_few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.tiled.pictures.STATISTICS_PIXELS", 600)
    picture = cat(90, 60)
    source, edited = Rows(picture, most=10 + 4), np.empty_like(picture)
    options = PLAIN | {"num_landmarks": 30}
    stream_detail(source, edited, ALPHA, tile_rows=10, sample=2000, memory=FEW, **options)
    assert source.read <= 3 * 90 * 14 // 10  # the pilot, the sample and the result, each with its halo
    np.testing.assert_array_equal(edited, streamed(picture, tile_rows=10, sample=2000, num_landmarks=30, memory=FEW))


def test_memory_gives_the_size_of_tiles() -> None:
    picture = Picture(np.zeros((20_000, 200, 3), np.uint8))

    def rows_within(memory: int, masked: bool = False) -> int:
        tiled = Tiled(picture, Passes("uint8", sample=1 << 16, memory=memory))
        return tiled.fitting_rows(75 if masked else 25, num_landmarks=5)

    rows = [rows_within(memory) for memory in (5 * 10**7, 2 * 10**8, 10**10)]
    assert 200 * 85 * 4 * rows[0] < 5 * 10**7 < 200 * 85 * 4 * 4 * rows[0]
    assert rows[0] < rows[1] == rows[2]  # longer tiles are no faster
    assert rows_within(13 * 10**7, masked=True) < rows[1]
    with pytest.raises(
        MemoryError, match=r"source needs at least \d+ MB of memory, but only 10 MB may be used; allow more"
    ):
        rows_within(10**7)
    with pytest.raises(MemoryError, match="source needs at least 7 MB of memory, but only 0 MB may be used"):
        streamed(cat(60, 80), memory=1000)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_ones_give_the_picture_back_with_its_transparency(kind: str, channels: int) -> None:
    draw = np.random.default_rng(0).random((30, 20, channels))
    picture = (draw if kind == "float32" else draw * np.iinfo(kind).max).astype(kind)
    edited = streamed(picture, torch.ones(3), num_landmarks=20)
    np.testing.assert_allclose(edited, picture, rtol=0, atol=2e-6 if kind == "float32" else 0)
    if channels == 1:
        np.testing.assert_allclose(streamed(picture[..., 0], torch.ones(3), num_landmarks=20), edited[..., 0])


def test_depth_is_that_of_the_target() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (30, 20, 4), np.uint8)
    deep = streamed(picture, torch.ones(2), kind="uint16", num_landmarks=20)
    np.testing.assert_array_equal(deep, picture.astype(np.uint16) * 257)
    floats = streamed(deep, torch.ones(2), kind="float32", num_landmarks=20)
    np.testing.assert_allclose(floats, picture / 255.0, atol=2e-6)


def test_equal_seeds_give_equal_pictures() -> None:
    picture = cat(40, 60)

    def edited(seed: int) -> Array:
        return streamed(picture, sample=1000, num_landmarks=20, generator=torch.Generator().manual_seed(seed))

    np.testing.assert_array_equal(edited(1), edited(1))
    assert not np.array_equal(edited(1), edited(2))


def test_report_tells_every_stage_and_its_end() -> None:
    seen: list[tuple[str, int, int]] = []
    streamed(
        cat(40, 60), sample=1000, num_landmarks=20, tile_rows=25, memory=FEW, report=lambda *step: seen.append(step)
    )
    stages = list(dict.fromkeys(stage for stage, _, _ in seen))
    assert stages == ["Looking", "Sampling", "Balancing", "Bounding", "Summing up", "Filtering"]
    assert seen[-3:] == [("Filtering", 0, 40), ("Filtering", 25, 40), ("Filtering", 40, 40)]


def test_random_landmarks_of_many_pixels_are_distinct(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(landmarks_module, "MANY", 400)
    chosen = candidate_pixels((21, 20), 30, "random", torch.Generator().manual_seed(0))
    assert len(chosen) == len(set(chosen.tolist())) == 30
    assert 0 <= int(chosen.min()) < int(chosen.max()) < 420


def test_more_landmarks_than_pixels_are_reduced() -> None:
    picture = cat(5, 6)
    assert np.abs(streamed(picture, num_landmarks=50) - in_memory(picture, num_landmarks=30)).max() < 1e-5


def test_balancing_that_does_not_settle_warns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.tiled.statistics.MAX_PASSES", 1)
    picture = GuidePicture(Picture(cat(30, 40)), Guide({}))
    pilot = sampling.take_pilot(picture, silent, num_landmarks=20)
    with pytest.warns(UserWarning, match="balancing still changed by .* after 1 passes"):
        balance_by_passes(lambda of: [of(pilot.sample)], 9 * pilot.moment, completed=True)


class Shrinking(Rows):
    """A file that is truncated after it was opened."""

    def __getitem__(self, rows: slice) -> Array:
        return super().__getitem__(rows)[: 5 if self.read > 40 else None]


def test_source_that_changes_its_size_is_named() -> None:
    source = Shrinking(cat(40, 30), most=100)
    with pytest.raises(ValueError, match="source must keep its size while it is read, 40 rows of 30"):
        stream_detail(source, np.empty_like(source.picture), ALPHA, num_landmarks=20, tile_rows=10)


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (lambda p: p[..., :0], {}, ValueError, r"source must have the shape \(H, W\) or \(H, W, S\)"),
        (lambda p: np.concatenate([p, p], axis=2), {}, ValueError, "one to four channels"),
        (lambda p: p.astype(np.int32), {}, TypeError, "source must hold one of uint8, .* got int32"),
        (lambda p: np.where(p > 0.5, np.nan, p), {}, ValueError, "source holds NaN or infinite pixels"),
        (lambda p: p, {"statistics": "some"}, ValueError, "statistics must be one of"),
        (lambda p: p, {"channels": "red"}, ValueError, "channels must be one of"),
        (lambda p: p, {"sample": 0}, ValueError, "sample must be at least 1"),
        (lambda p: p, {"tile_rows": 0}, ValueError, "tile_rows must be at least 1"),
        (lambda p: p, {"residual": float("nan")}, ValueError, "residual must be finite"),
        (lambda p: p, {"alpha": torch.ones(1, 3)}, ValueError, "alpha must have shape"),
        (lambda p: p, {"num_landmarks": 0}, ValueError, "num_landmarks must be at least 1"),
        (lambda p: p, {"photometric_bandwidth": -1.0}, ValueError, "photometric_bandwidth must be positive"),
        (lambda p: p, {"photometric_bandwidth": "wide"}, ValueError, "photometric_bandwidth must be one of"),
        (lambda p: p, {"spatial_bandwidth": 0.0}, ValueError, "spatial_bandwidth must be positive"),
        (lambda p: p, {"landmarks": "best"}, ValueError, "landmarks must be one of"),
        (lambda p: p, {"completion": "all"}, ValueError, "completion must be one of"),
        (lambda p: p, {"guide_channels": "red"}, ValueError, "guide_channels must be one of"),
        (lambda p: p, {"patch_size": 4}, ValueError, "patch_size must be odd"),
        (lambda p: p, {"tolerance": 1e-3}, TypeError, "tolerance"),
    ],
)
def test_what_cannot_be_used_is_named(change: Any, options: dict[str, Any], error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        streamed(change(cat(20, 30)), **options)


def test_target_must_fit() -> None:
    picture = cat(20, 30)
    with pytest.raises(ValueError, match="target must have the shape of the source"):
        stream_detail(picture, np.empty((20, 30), np.float32), ALPHA)
    with pytest.raises(ValueError, match="dtype of the target must be one of"):
        stream_detail(picture, np.empty((20, 30, 3), np.int64), ALPHA)
