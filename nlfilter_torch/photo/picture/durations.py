"""The stages of edits in tiles, and how long they take compared with each other, for the estimate of the time left.

``durations.json`` has for each stage the seconds on a core until all of it is reported, those for each megapixel in
addition, and both for what follows until the next stage; for pictures up to the viewing size, and for larger ones, that
filters look at in that size. ``python -m benchmarks.durations`` measures them, with the defaults of ``MEASURED``, in
processes that do nothing else, since memory that a process uses for the first time takes up to a second.
"""

import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from nlfilter_torch.core.progress import Stage
from nlfilter_torch.photo.declared.shared_parameters import VIEWING_SIZE
from nlfilter_torch.photo.declared.steps import Step, acting_steps

USUAL = 5.0  # seconds
WRITING = {".png": 0.21}  # seconds of writing a megapixel of photographs, by the suffix of the file
QUICK_WRITING = 0.02  # of other files
STRAIGHTENING = 0.1  # seconds of straightening a megapixel
#: Parameters that change how long an edit takes; it is known for their defaults only.
MEASURED = ("method", "viewing_size", "landmarks", "sampling", "patch_size")


class Line(NamedTuple):
    """A stage in the file: seconds until all of it is reported, and those after that, with those of a megapixel."""

    name: str
    seconds: float
    more_seconds: float
    rest: float
    more_rest: float

    def stage(self, megapixels: float) -> Stage:
        """The stage on a picture of that size."""
        seconds, rest = self.seconds + self.more_seconds * megapixels, self.rest + self.more_rest * megapixels
        return Stage(self.name, seconds, rest)


@cache
def _durations() -> dict[str, dict[str, list[Line]]]:
    """What the file says of "small" and "large" pictures, by edit."""
    text = files("nlfilter_torch.photo.picture").joinpath("durations.json").read_text()
    return {
        edit: {kind: [Line(*line) for line in lines] for kind, lines in kinds.items()}
        for edit, kinds in json.loads(text).items()
    }


def expected_stages(steps: Iterable[Step], size: tuple[int, int]) -> list[Stage]:
    """The stages of an edit of a photograph (H, W) in tiles; none if those of a step are not known."""
    stages = [stages_of(step, size, regional=step.has_region()) for step in acting_steps(steps)]
    return list(chain.from_iterable(stages)) if all(stages) else []


def duration(step: Step, size: tuple[int, int]) -> float:
    """How long a step takes on a photograph (H, W), compared with others; as long as usual if that is not known."""
    return sum(stage.total for stage in stages_of(step, size, regional=step.has_region())) or USUAL


def writing(size: tuple[int, int], path: Path) -> float:
    """How long it takes to write a photograph (H, W) to a file."""
    return WRITING.get(path.suffix.lower(), QUICK_WRITING) * size[0] * size[1] / 1e6


def straightening(size: tuple[int, int]) -> Stage:
    """The stage in which a photograph is straightened, before all steps; (H, W) is its size afterwards."""
    return Stage("Straightening", STRAIGHTENING * size[0] * size[1] / 1e6)


def written(stages: list[Stage], size: tuple[int, int], path: Path) -> list[Stage]:
    """Stages of which the last one writes its rows to a file, too."""
    return [*stages[:-1], *(replace(last, seconds=last.seconds + writing(size, path)) for last in stages[-1:])]


def stages_of(step: Step, size: tuple[int, int], *, regional: bool) -> list[Stage]:
    """The stages of a step on a photograph (H, W), in a region or everywhere; none if they are not known."""
    name = f"{step.edit} of a region" if regional else step.edit
    if name not in _durations() or any(step[p.name] != p.default for p in step.declared if p.name in MEASURED):
        return []
    megapixels = size[0] * size[1] / 1e6
    kind = "small" if megapixels <= VIEWING_SIZE.default_number else "large"
    return [line.stage(megapixels) for line in _durations()[name][kind]]
