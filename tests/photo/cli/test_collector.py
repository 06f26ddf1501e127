"""The program does not look for circles of objects at its end, nor often before."""

import subprocess
import sys

from nlfilter_torch.photo.cli.collector import THRESHOLDS

PROGRAM = f"""
import atexit, gc
atexit.register(lambda: print(gc.get_freeze_count() > 1000, gc.get_threshold() == {THRESHOLDS}))  # called last
from nlfilter_torch.__main__ import main
main(["--version"])
main(["--version"])
"""


def test_the_program_leaves_objects_alone_at_its_end() -> None:
    result = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "True True"
