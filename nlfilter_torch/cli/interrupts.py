"""Ctrl-C at moments when Python itself would lose it."""

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

PAUSE = 0.05  # seconds until a lost interrupt comes again: long enough for the callback that lost it to be over


@contextmanager
def heeded() -> Iterator[None]:
    """Repeat an interrupt that comes while Python runs a destructor or a callback, such as those after each import.

    Python can raise nothing there: it would print "Exception ignored in" and go on with the work to its end.
    """
    former = sys.unraisablehook
    repeats: list[threading.Timer] = []

    def hook(lost: "sys.UnraisableHookArgs") -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            former(lost)
            return
        repeats.append(threading.Timer(PAUSE, _thread.interrupt_main))  # here it would be lost once more
        repeats[-1].daemon = True
        repeats[-1].start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = former
        for repeat in repeats:
            repeat.cancel()
