"""Stages that edits are expected to have, and the time left of recorded runs, with a simulated clock."""

import json
from pathlib import Path
from typing import TypedDict

import pytest

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo import Step, Stroke
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.picture.durations import duration, expected_stages, stages_of, writing, written
from tests.recipes import IN, RECOLOR


class Run(TypedDict):
    """A command, with a thread or two: the edits, the size, and reports of progress, with seconds of the processor."""

    edits: list[str]
    size: tuple[int, int]
    reports: list[tuple[float, str, int, int]]


#: On the cat, and on the picture of ``benchmarks.durations`` in another size.
RUNS: list[Run] = json.loads(Path(__file__).with_name("recorded_runs.json").read_text())
SIZE = (2000, 3000)
DETAIL = Step("detail", alpha=(2.0, 1.0))


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_stages_of_a_recipe_are_those_of_its_steps() -> None:
    stages = expected_stages([DETAIL, Step.idle("tone"), Step("sharpen")], SIZE)
    assert stages == stages_of(DETAIL, SIZE, regional=False) + stages_of(Step("sharpen"), SIZE, regional=False)
    assert {"Looking", "Sampling", "Filtering"} <= {stage.name for stage in stages}
    assert all(stage.seconds >= 0 and stage.rest >= 0 for stage in stages)


def test_larger_photographs_take_longer() -> None:
    for step in (DETAIL, RECOLOR, Step("denoise")):
        assert duration(step, (500, 500)) < duration(step, (1000, 1400)) < duration(step, (4000, 6000))
    region = Step("detail", (Stroke(IN.points, IN.radius, "in"),), alpha=(0.5, 1.0), inside=(3.0, 1.0))
    assert expected_stages([region], SIZE) == stages_of(DETAIL, SIZE, regional=True) != expected_stages([DETAIL], SIZE)


def test_an_edit_without_known_durations_is_as_long_as_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.durations._durations", dict)
    assert expected_stages([DETAIL], SIZE) == []
    assert duration(DETAIL, SIZE) > 0


def test_the_last_stage_writes_the_file() -> None:
    (*_, last), path = expected_stages([DETAIL], SIZE), Path("out.PNG")
    (*rest, longer) = written(expected_stages([DETAIL], SIZE), SIZE, path)
    assert longer.total - last.total == pytest.approx(writing(SIZE, path))
    assert 0 < writing(SIZE, Path("out.jpg")) < writing(SIZE, path)
    assert written([], SIZE, path) == [] != rest


@pytest.mark.parametrize(
    ("edit", "values"),
    [
        ("denoise", {"method": "rule"}),
        ("detail", {"viewing_size": 0.0}),
        ("tone", {"landmarks": 20}),
        ("sharpen", {"patch_size": 3}),
        ("detail", {"sampling": "uniform"}),
    ],
)
def test_durations_are_not_known_for_other_parameters_that_change_them(edit: str, values: dict[str, Value]) -> None:
    step = Step(edit, **values)
    assert step.values
    assert expected_stages([Step(edit).changed(bandwidth=12.0)], SIZE)  # takes as long
    assert expected_stages([step], SIZE) == []


@pytest.mark.parametrize("run", RUNS, ids=[" ".join((*run["edits"], str(run["size"][0]))) for run in RUNS])
def test_recorded_runs(run: Run) -> None:
    """Half-way, the time left is within a quarter of the truth, and it never rises by more than a tenth."""
    size, clock, least, half = run["size"], Clock(), float("inf"), None
    steps = [(Step(name.removesuffix(" of a region")), name.endswith(" of a region")) for name in run["edits"]]
    stages = [stage for step, regional in steps for stage in stages_of(step, size, regional=regional)]
    told = Progress(clock, written(stages, size, Path("out.png")))
    *reports, (total, *_) = run["reports"]
    for tick in range(400):
        while reports and reports[0][0] <= total * tick / 400:
            clock.now, stage, done, rows = reports.pop(0)
            told(stage, done, rows)
        clock.now = total * tick / 400
        left = told.seconds_left
        if left is not None:
            assert left <= 1.1 * least + 1e-9
            least = min(left, least)
        if tick == 200:
            half = left
    assert half == pytest.approx(total / 2, rel=0.25)
