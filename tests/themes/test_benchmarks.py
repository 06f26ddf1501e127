"""The benchmarks run, and report what they could not measure; speed is not tested."""

import copy
import itertools
import json
import math
import sys
from dataclasses import asdict, replace

import pytest
import torch

from benchmarks.speed import peers
from benchmarks.speed.__main__ import main as measure
from benchmarks.speed.__main__ import run
from benchmarks.speed.cases import Case
from benchmarks.speed.claims import claims
from benchmarks.speed.comparisons import (
    CROPS,
    DOUBLE_PRECISION,
    DOUBLED,
    GROWTH,
    MANY,
    RESPONSE,
    SLIDER,
    THREADS,
    comparisons,
)
from benchmarks.speed.floor import READS, floor_calls, floor_summary
from benchmarks.speed.plan import QUICK
from benchmarks.speed.suites import SUITES
from benchmarks.speed.timing import Timing, compare, on_threads, take_turns
from docs import speed
from docs.pages import between

MEASURED = ("main", "comparisons", "pictures", "pauses", "slow", "dense", "autograd", "landmarks", "dtypes")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The results that a quick run writes."""
    path = tmp_path_factory.mktemp("speed") / "new" / "speed.json"
    measure(["--quick", "--only", *MEASURED, "--out", str(path)])
    return json.loads(path.read_text())


@pytest.mark.slow
def test_quick_run_measures_every_suite_it_was_asked_for(results):
    assert results["quick"]
    assert not results["cut"]
    ran = {record["suite"] for record in results["results"]}
    assert ran == set(MEASURED)
    for record in results["results"]:
        for timing in record["timings"].values():
            assert timing["median"] > 0
            assert timing["samples"] >= 1
    main = next(record for record in results["results"] if record["suite"] == "main")
    assert main["error"]["rms"] < 0.1
    assert main["floor"]["seconds"] == pytest.approx(main["floor"]["products"] + READS * main["floor"]["read"])
    assert {"operator", "slider, layers held", "kornia guided 11x11"} <= main["timings"].keys()


@pytest.mark.slow
def test_report_of_a_run_has_its_tables_and_plots(results, tmp_path):
    source = tmp_path / "speed.json"
    source.write_text(json.dumps(results))
    speed.main([str(source)])
    text = (tmp_path / "speed.md").read_text()
    for part in (
        "## Claims",
        "scikit-image NLM 7/11",
        "## Over the number of landmarks",
        "dense filter by attention",
        "## Two at a time, alternating",
    ):
        assert part in text
    assert "holds" not in text  # no claim of a quick run is judged
    assert "falls short" not in text
    for name in ("speed_growth.png", "speed_peers.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_page_takes_full_runs_only_and_loses_nothing_around_the_markers(results, tmp_path):
    source, page = tmp_path / "speed.json", tmp_path / "page.md"
    page.write_text(f"before\n\n{speed.BEGIN}\nstale\n{speed.END}\n\nafter\n")
    source.write_text(json.dumps(results))
    with pytest.raises(SystemExit, match="full run"):
        speed.main([str(source), "--page", str(page)])
    assert "stale" in page.read_text()
    source.write_text(json.dumps(copy.deepcopy(results) | {"quick": False}))
    speed.main([str(source), "--page", str(page)])
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\n\nafter\n")
    assert "stale" not in text
    assert "OpenCV" in text
    assert not (tmp_path / "speed.md").exists()


def test_a_page_without_markers_is_refused():
    with pytest.raises(ValueError, match="must hold the lines"):
        between("a text", "a table", speed.BEGIN, speed.END)


def test_a_missing_peer_names_its_extra_and_the_rest_goes_on(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    calls, missing = peers.prepare_all(peers.QUICK_PEERS, Case(height=24, width=24))
    assert set(missing) == {peers.OPENCV_NLM.name, peers.OPENCV_DETAIL.name}
    assert all("nlfilter-torch[bench]" in remedy for remedy in missing.values())
    assert set(calls) == {peers.NLM_5_6.name, peers.BILATERAL.name, peers.GUIDED.name}


def test_suites_that_come_too_late_are_named(tmp_path):
    path = tmp_path / "speed.json"
    measure(["--quick", "--only", "threads", "--minutes", "0", "--out", str(path)])
    results = json.loads(path.read_text())
    assert results["cut"] == ["threads"]
    assert results["results"] == []
    assert "Time was up during or before: threads" in speed.report(results)


def test_a_suite_stops_between_two_cases_when_time_is_over(monkeypatch):
    def two_cases(plan):
        yield {"suite": "two", "label": "first", "timings": {}}
        yield {"suite": "two", "label": "second", "timings": {}}

    monkeypatch.setitem(SUITES, "two", two_cases)
    looks = itertools.chain([True], itertools.repeat(False))  # the clock runs out during the first case
    monkeypatch.setattr("benchmarks.speed.__main__.is_time_left", lambda start, minutes: next(looks))
    results = run(QUICK, ["two"], minutes=1.0)
    assert [record["label"] for record in results["results"]] == ["first"]
    assert results["cut"] == ["two"]


def test_claims_are_ratios_of_medians():
    case = QUICK.case()
    seconds = {"operator": 1.5, "affinity: whole": 0.1, "whitening: whole": 0.2, "gram: whole": 0.2, "read: sum": 0.05}
    timings = {name: Timing(value, 0.0, 1, 1) for name, value in seconds.items()}
    record = {
        "suite": "main",
        "label": "",
        "case": asdict(case),
        "timings": {name: asdict(timing) for name, timing in timings.items()},
        "floor": floor_summary(timings),
    }
    judged = claims({"quick": False, "results": [record]})
    assert len(judged) == 1  # the others were not measured
    assert judged[0].value == pytest.approx(1.5)  # floor: 0.1 + 2 x 0.2 + 10 x 0.05 = 1
    assert judged[0].holds
    timings["operator"] = Timing(1.7, 0.0, 1, 1)
    record["timings"]["operator"] = asdict(timings["operator"])
    assert claims({"quick": False, "results": [record]})[0].holds is False


COMPARED = {
    DOUBLED: "time of twice the pixels",
    GROWTH: "exponent of m",
    MANY: "operator of 256x256: m = 1000 / m = 250",
    DOUBLE_PRECISION: "operator of 384x384: float64 / float32",
    CROPS: "training step on 16 crops",
    SLIDER: "slider move, layers held / one read",
    RESPONSE: "any other response",
}


@pytest.fixture(scope="module")
def compared():
    """The records of a quick run of all comparisons, as read from JSON."""
    return json.loads(json.dumps(list(comparisons(QUICK))))


def test_every_comparison_has_two_timings_and_their_ratio(compared):
    assert {record["label"] for record in compared} == {*COMPARED, THREADS, "an operator of crops"}
    for record in compared:
        first, second = (timing["median"] for timing in record["timings"].values())
        assert record["ratio"]["pairs"] == 1  # with a single pair, all three equal its ratio
        assert [record["ratio"][name] for name in ("lower", "median", "upper")] == pytest.approx([second / first] * 3)
    assert compared[0]["case"]["width"] == 2 * compared[0]["case"]["height"]  # the doubled one is the second


def test_one_thread_is_not_compared_with_itself():
    assert THREADS not in {record["label"] for record in comparisons(replace(QUICK, threads=(1,)))}


@pytest.mark.parametrize(("label", "text"), COMPARED.items())
def test_a_claim_is_judged_by_the_median_ratio_and_shows_its_quartiles(compared, label, text):
    def judged(median):
        ratio = {"lower": 0.5 * median, "median": median, "upper": 1.25 * median, "pairs": 5}
        records = [record | {"ratio": ratio} for record in compared if record["label"] == label]
        result = claims({"quick": False, "results": records})
        (claim,) = result
        assert claim.name.startswith(text)
        return claim

    limit = judged(1.0).limit
    edge = 4**limit if label == GROWTH else limit  # the exponent from a quarter of the landmarks
    assert judged(0.99 * edge).holds
    assert judged(1.01 * edge).holds is False
    expected = [value / math.log(4) for value in (math.log(2), math.log(5))] if label == GROWTH else [2.0, 5.0]
    assert judged(4.0).quartiles == pytest.approx(expected)
    assert "({:.2f} to {:.2f})".format(*expected) in speed.claims_table([judged(4.0)])


def test_the_worst_of_several_comparisons_counts(compared):
    medians = iter([1.9, 2.3, 2.0, 2.1])
    doubled = next(record for record in compared if record["label"] == DOUBLED)
    records = [
        doubled | {"ratio": {"lower": median - 0.1, "median": median, "upper": median + 0.1, "pairs": 5}}
        for median in medians
    ]
    (claim,) = claims({"quick": False, "results": records})
    assert claim.value == 2.3
    assert claim.holds is False
    assert claim.quartiles == pytest.approx((2.2, 2.4))


def test_a_slow_moment_does_not_change_the_ratio_of_calls_that_alternate(monkeypatch):
    """B takes twice as long as A; from B of the third of five pairs on, the machine is ten times slower."""
    order, now = [], [0.0]

    def call(name, cost):
        def run():
            order.append(name)
            now[0] += cost * (10 if len(order) > 12 else 1)  # a warm-up each, then two calls of each per pair

        return run

    monkeypatch.setattr("benchmarks.speed.timing.timer", lambda: now[0])
    timings, ratio = compare({"a": call("a", 1.0), "b": call("b", 2.0)}, threads=1, seconds=0.0, least=5)
    rounds = [name for name, previous in zip(order, [None, *order], strict=False) if name != previous]
    assert rounds == ["a", "b"] * 6  # a warm-up, then five pairs
    assert timings["b"].median / timings["a"].median == pytest.approx(20)  # the ratio of the medians
    assert ratio.pairs == 5
    assert [ratio.lower, ratio.median, ratio.upper] == pytest.approx([2.0] * 3)
    assert {timing.samples for timing in timings.values()} == {5}


def test_the_ratio_is_of_one_call_each_however_many_a_sample_takes(monkeypatch):
    now = [0.0]

    def call(cost):
        def run():
            now[0] += cost

        return run

    monkeypatch.setattr("benchmarks.speed.timing.timer", lambda: now[0])
    _, ratio = compare({"a": call(0.001), "b": call(0.5)}, threads=1, seconds=0.0, least=2)
    assert ratio.median == pytest.approx(500)


def test_calls_on_threads_of_their_own_leave_those_of_the_others():
    before, seen = torch.get_num_threads(), []
    on_threads(lambda: seen.append(torch.get_num_threads()), before + 1)()
    assert seen == [before + 1]
    assert torch.get_num_threads() == before


def test_calls_take_turns():
    order = []
    timings = take_turns(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")}, threads=1, seconds=0.0, least=2
    )
    assert {timing.samples for timing in timings.values()} == {2}
    rounds = [name for name, previous in zip(order, [None, *order], strict=False) if name != previous]
    assert rounds == ["a", "b"] * 3  # a warm-up, then two rounds


def test_floor_has_one_way_of_each_part():
    parts = [name.split(": ")[0] for name in floor_calls(Case(height=16, width=16, landmarks=8))]
    assert parts == ["affinity", "whitening", "gram", "read"]


def test_tiles_of_a_batch_are_the_pixels_of_one_image():
    batch, whole = Case(batch=4, height=16, width=16).image(), Case(height=32, width=32).image()
    assert batch.shape == (4, 1, 16, 16)
    assert (batch[1] == whole[0, :, :16, 16:]).all()
    assert (batch[2] == whole[0, :, 16:, :16]).all()
