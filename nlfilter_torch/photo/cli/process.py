"""How the process of the program behaves: on signals, and what is set before torch is loaded, which this precedes.

**Waiting threads.** By default a thread of OpenMP spins for milliseconds until the others are done. Beside busy
processes it spends its share of a core on waiting, while the thread that it waits for has none: edits take up to twenty
times as long. If threads sleep at once, an idle machine takes up to 1.4 times as long, since an edit divides thousands
of short operations. So threads spin for as long as it takes to wake one, and then sleep (measured by
``benchmarks.busy``). A library cannot set this, since its user may have loaded torch before.

**Circles of objects.** Torch and what it needs are hundreds of thousands of objects that stay until the program ends.
By default Python looks at them for circles several times while they are loaded, and once more at the end: 0.7 s, a
third of the time of a small edit. No command waits for it, since pixels are freed as soon as they are no longer used;
the editor sets it back.
"""

import atexit
import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import FrameType

INTERRUPTED = 128 + signal.SIGINT  # exit status that shells use for Ctrl-C
ENDINGS = tuple(signal.Signals[name] for name in ("SIGTERM", "SIGHUP") if name in signal.Signals.__members__)

#: Variables of the environment by which users say how threads wait: those of the standard, GCC and LLVM.
VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")

#: How often a thread of GCC's OpenMP looks whether the others are done before it sleeps; about 10 microseconds.
SPINS = 600

#: Objects, and multiples, after which Python looks at the youngest, the younger and all objects; 700, 10 and 10 before.
THRESHOLDS = (20_000, 20, 100)


class Ended(SystemExit):
    """SIGTERM or SIGHUP, raised in the main thread so that unfinished files are removed."""

    def __init__(self, number: int) -> None:
        """Set the exit status that shells use for signal ``number``."""
        self.status = 128 + number
        super().__init__(self.status)


def tell() -> int:
    """Report the interrupt and return the exit status."""
    sys.stderr.write("nlfilter-torch: interrupted; no file is half written\n")
    return INTERRUPTED


@contextmanager
def handled() -> Iterator[None]:
    """Raise :class:`Ended` in the block for signals that end the program, as Python does KeyboardInterrupt for Ctrl-C.

    Signals without Python's own handler are left as they are: jobs under nohup ignore SIGHUP, and a program that runs
    this one may have its own handlers.
    """
    here = threading.current_thread() is threading.main_thread()
    replaced = [number for number in ENDINGS if here and signal.getsignal(number) is signal.SIG_DFL]
    for number in replaced:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in replaced:
            signal.signal(number, signal.SIG_DFL)


def _end(number: int, _: FrameType | None) -> None:
    raise Ended(number)


def sleep_while_waiting() -> None:
    """Let threads that have nothing to do sleep soon, in this process and its workers, unless the user decided."""
    if not any(name in os.environ for name in VARIABLES):
        os.environ["OMP_WAIT_POLICY"] = "passive"  # for other implementations of OpenMP
        os.environ["GOMP_SPINCOUNT"] = str(SPINS)  # which takes precedence in GCC's


@cache
def collect_seldom() -> None:
    """Look for circles less often in this process, and no longer at its end."""
    gc.set_threshold(*THRESHOLDS)
    atexit.register(gc.freeze)  # what is frozen is not looked at
