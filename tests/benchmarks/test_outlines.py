"""Outlines of objects drawn by hand: what is stored, and how selections are scored by them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.free_photographs import edited_photographs
from benchmarks.keepers import Job
from benchmarks.outlines import (
    BOXED,
    INNER,
    INNER_BOXED,
    OURS,
    RADIUS,
    SETS,
    Outline,
    Score,
    Stability,
    by_peer,
    filled,
    line,
    main,
    means,
    measure,
    outlines,
    overlay,
    score,
    selected,
    separated,
    stability,
    with_one_moved,
)

CORNER = ((0.205, 0.205), (0.595, 0.205), (0.595, 0.595), (0.205, 0.595))
SQUARE = ((0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75))
STROKE = {"paint": "in", "points": [[0.4, 0.5], [0.6, 0.5]], "radius": 0.05}


def job(edit: str, **entries: object) -> Job:
    return Job.of(1, {"photograph": "coffee", "what": "a square", "edit": edit, "strokes": [STROKE]} | entries)


def scene() -> torch.Tensor:
    image = torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(0)) * 0.2
    image[:, 0, 10:30, 15:45] += 0.6
    return image


def test_stored_outlines_are_of_different_jobs_and_of_polygons_inside_their_pictures():
    stored = outlines()
    assert {outline.set for outline in stored} == set(SETS)
    assert len({(outline.set, outline.job.name) for outline in stored}) == len(stored) == 22 + 3 * 25 + 89
    for outline in stored:
        assert outline.job.edit in ("recolor", "mask", "defocus", "detail")
        for polygon in (*outline.outlines, *outline.holes, *outline.either):
            assert len(polygon) >= 3
            assert all(0 <= coordinate <= 1 for point in polygon for coordinate in point)
        assert 0.003 < outline.object((90, 120)).mean() < 0.8


def test_strokes_drawn_for_outlines_are_of_other_photographs_of_the_reporting_set_and_on_their_sides():
    stored = outlines()
    own = [outline for outline in stored if outline.set in ("short", "generous")]
    of_jobs = {outline.job.photograph for outline in stored if outline.set in ("choosing", "reporting")}
    for outline in own:
        assert edited_photographs()[outline.job.photograph].set == "reporting"
        assert outline.job.photograph not in of_jobs
        assert all(stroke.radius == RADIUS for stroke in outline.job.strokes)
        size = (400, 600)
        sides = separated(outline.job.strokes, size)
        assert sides[1] is not None
        counted = ~filled(outline.either, size)
        for side, wanted in zip(sides, (outline.object(size), ~outline.object(size)), strict=True):
            drawn = (side[0, 0].numpy() > 0) & counted
            assert (drawn & wanted).sum() > 0.9 * drawn.sum() > 0


def test_object_is_the_union_of_its_outlines_without_its_holes():
    apart = Outline(job("mask"), (SQUARE, ((0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1))))
    filled = apart.object((100, 200))
    assert filled[26:74, 51:149].all()
    assert filled[1:9, 1:18].all()
    assert filled.sum() == pytest.approx(100 * 200 * 0.26, rel=0.06)
    hollow = Outline(apart.job, (SQUARE,), (((0.4, 0.4), (0.6, 0.4), (0.6, 0.6), (0.4, 0.6)),)).object((100, 200))
    assert not hollow[42:58, 82:118].any()
    assert hollow[30, 100]


def test_random_strokes_lie_on_their_sides_of_the_outline_and_differ_by_the_seed():
    for kind in ("random", "training"):
        for outline in [outline for outline in outlines() if outline.set == kind][::10]:
            size = (120, 180)
            inside, outside = outline.sides(size)
            drawn = outline.scribbles(size)
            assert drawn[1] is not None
            for side, allowed in zip(drawn, (inside, outside), strict=True):
                assert side.sum() > 0
                assert not side[0, 0].numpy()[~allowed].any()
            again, other = (replace(outline, seed=seed).scribbles(size)[0] for seed in (outline.seed, 1000))
            assert torch.equal(again, drawn[0])
            assert not torch.equal(other, drawn[0])


def test_score_does_not_count_a_band_around_the_outline():
    outline, corner = Outline(job("mask"), (CORNER,)), ((0.4, 0.2), (0.6, 0.2), (0.6, 0.4), (0.4, 0.4))
    sides, wanted = outline.sides((100, 100)), outline.object((100, 100))
    assert score(wanted, sides) == Score(1.0, 0.0, 0.0)
    wider = np.zeros_like(wanted)
    wider[19:61, 20:60] = True
    assert score(wider, sides) == Score(1.0, 0.0, 0.0)
    half = wanted.copy()
    half[40:, :] = False
    half[:19, :76] = True
    inside, beside = 38 * 38, 19 * 76
    scored = score(half, sides)
    assert scored.missed == pytest.approx(0.5, abs=0.03)
    assert scored.outside == pytest.approx(beside / inside, rel=0.06)
    assert scored.overlap == pytest.approx((1 - scored.missed) / (1 + scored.outside))
    assert score(half, replace(outline, either=(((0.2, 0.38), (0.6, 0.38), (0.6, 0.6), (0.2, 0.6)),)).sides((100, 100))
                 ).missed == 0  # fmt: skip
    assert (
        score(half, replace(outline, either=(((0, 0), (1, 0), (1, 0.19), (0, 0.19)),)).sides((100, 100))).outside == 0
    )
    assert not replace(outline, either=(corner,)).sides((100, 100))[0][25:35, 45:55].any()


def test_box_is_that_of_the_object_with_a_margin_inside_the_picture():
    assert Outline(job("mask"), (SQUARE,)).box((100, 200)) == pytest.approx((48, 23, 152, 77), abs=1)
    whole = (((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)),)
    assert Outline(job("mask"), whole).box((100, 200)) == (0, 0, 200, 100)


def test_masks_of_every_kind_of_job_and_of_peers_select_the_object():
    image, wanted = scene(), Outline(job("mask"), (SQUARE,))
    recoloured = job(
        "recolor", strokes=[STROKE | {"paint": "#0040c0"}, STROKE | {"paint": "out", "points": [[0.1, 0.5]]}]
    )
    box = wanted.box((40, 60))
    each = [replace(wanted, job=own) for own in (job("mask"), job("defocus"), recoloured)]
    masks = [selected(one, image, box) for one in each] + [selected(one, image) for one in each]
    masks += [selected(each[2], image, alone=True), by_peer("GrabCut", wanted, image, box)]
    for mask in masks:
        assert mask.shape == (1, 1, 40, 60)
        assert score(mask[0, 0].numpy() > 0.5, wanted.sides((40, 60))).overlap > 0.95
    scores = measure(replace(wanted, job=recoloured), image, peers=True)
    assert list(scores) == [OURS, BOXED, INNER, INNER_BOXED, "GrabCut", "GrabCut, r.", "matting, r."]
    assert all(found.overlap > 0.95 for found in scores.values())
    assert list(measure(wanted, image)) == [OURS, BOXED]


def test_means_are_of_the_methods_that_all_objects_have():
    rows = [{OURS: Score(1.0, 0.0, 0.0), INNER: Score(0.5, 0.0, 1.0)}, {OURS: Score(0.5, 0.5, 0.0)}]
    assert means(rows) == {OURS: Score(0.75, 0.25, 0.0)}
    assert line("mean", means(rows), [OURS, INNER]).split() == ["mean", "0.750", "25.0%", "0.0%", "-"]


def test_only_the_set_that_is_asked_for_is_measured(capsys):
    assert main(["--quick", "--set", "choosing"]) == 0
    assert "mean of 1, choosing" in capsys.readouterr().out
    assert main(["--set", "short"]) == 0  # whose photographs are not there
    assert "mean" not in capsys.readouterr().out


def test_stability_is_that_of_masks_from_many_strokes():
    found = stability(Outline(job("mask"), (SQUARE,), seed=0), scene(), 2)
    assert found == Stability(1.0, pytest.approx(1.0, abs=0.05), 1.0)


def test_a_moved_stroke_goes_aside_by_its_width_and_the_others_stay():
    outline = Outline(job("mask"), (SQUARE,), seed=3)
    strokes, (inside, _) = outline.scribbles((90, 120))[0], outline.sides((90, 120))
    for number in range(3):
        moved = with_one_moved(strokes, inside, number)
        assert not torch.equal(moved, strokes)
        assert not moved[0, 0].numpy()[~inside].any()
        assert (moved * strokes).sum() > 0.4 * strokes.sum()


def test_overlay_tints_what_is_missed_and_what_is_beside_the_object():
    image, wanted, mask = torch.full((1, 3, 4, 4), 0.5), np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    wanted[0], mask[0, :2], mask[3, 3] = True, True, True
    shown = overlay(image, mask, wanted)[0]
    assert torch.equal(shown[:, 0, 0], image[0, :, 0, 0])
    assert shown[0, 0, 3] > shown[2, 0, 3]
    assert shown[2, 3, 3] > shown[0, 3, 3]
    assert shown[0, 2, 0] < 0.2
