"""The benchmarks run and tell the truth about what they could not measure; how fast they are is not tested."""

import copy
import itertools
import json
import sys

import pytest

from benchmarks import report
from benchmarks.speed import peers
from benchmarks.speed.__main__ import main as measure
from benchmarks.speed.__main__ import run
from benchmarks.speed.cases import Case
from benchmarks.speed.claims import claims
from benchmarks.speed.floor import READS, floor_calls, floor_summary
from benchmarks.speed.plan import QUICK
from benchmarks.speed.suites import SUITES
from benchmarks.speed.timing import Timing, take_turns

MEASURED = ("main", "growth", "batches", "pictures", "pauses", "slow", "dense", "autograd", "landmarks", "dtypes")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """What a quick run writes, read back."""
    path = tmp_path_factory.mktemp("speed") / "new" / "speed.json"
    measure(["--quick", "--only", *MEASURED, "--out", str(path)])
    return json.loads(path.read_text())


@pytest.mark.slow
def test_quick_run_measures_every_suite_it_was_asked_for(results):
    assert results["quick"]
    assert not results["cut"]
    ran = {record["suite"] for record in results["results"]}
    assert ran == {*MEASURED, "growth in pixels", "growth in landmarks"} - {"growth"}
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
    report.main([str(source)])
    text = (tmp_path / "speed.md").read_text()
    for part in ("## Claims", "scikit-image NLM 7/11", "## Over the number of landmarks", "dense filter by attention"):
        assert part in text
    assert "not measured" in text  # of a quick run, no claim is judged
    assert "holds" not in text
    for name in ("speed_growth.png", "speed_peers.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_readme_takes_full_runs_only_and_loses_nothing_around_the_markers(results, tmp_path):
    source, readme = tmp_path / "speed.json", tmp_path / "README.md"
    readme.write_text(f"before\n\n{report.BEGIN}\nstale\n{report.END}\n\nafter\n")
    source.write_text(json.dumps(results))
    with pytest.raises(SystemExit, match="full run"):
        report.main([str(source), "--readme", str(readme)])
    assert "stale" in readme.read_text()
    source.write_text(json.dumps(copy.deepcopy(results) | {"quick": False}))
    report.main([str(source), "--readme", str(readme)])
    text = readme.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\n\nafter\n")
    assert "stale" not in text
    assert "OpenCV" in text


def test_a_readme_without_markers_is_refused():
    with pytest.raises(ValueError, match="must hold the lines"):
        report.between_markers("a text", "a table")


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
    assert "Time was up during or before: threads" in report.report(results)


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
        "case": case.to_json(),
        "timings": {name: timing.to_json() for name, timing in timings.items()},
        "floor": floor_summary(timings),
    }
    judged = claims({"quick": False, "results": [record]})
    assert judged[0].measured == pytest.approx(1.5)  # floor: 0.1 + 2 x 0.2 + 10 x 0.05 = 1
    assert judged[0].holds
    assert [claim.holds for claim in judged[1:]] == [None] * (len(judged) - 1)
    timings["operator"] = Timing(1.7, 0.0, 1, 1)
    record["timings"]["operator"] = timings["operator"].to_json()
    assert claims({"quick": False, "results": [record]})[0].holds is False


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
