"""Ctrl-C, SIGTERM and SIGHUP end the work without a traceback or an unfinished file, and set the exit status.

This module is imported before anything that takes time.
"""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 128 + signal.SIGINT  # exit status, as shells have it for Ctrl-C
PAUSE = 0.05  # seconds until a lost interrupt is repeated, when the callback that lost it has returned
SHOW_CURSOR = "\x1b[?25h"
ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class Ended(SystemExit):
    """SIGTERM or SIGHUP, raised in the main thread so that unfinished files are removed."""

    def __init__(self, number: int) -> None:
        """The exit status is the one that shells use for the signal of that number."""
        self.number, self.status = number, 128 + number
        super().__init__(self.status)


def tell() -> int:
    """Say that the work was interrupted; return the exit status."""
    sys.stderr.write("nlfilter-torch: interrupted; no file is half written\n")
    return INTERRUPTED


@contextmanager
def handled() -> Iterator[None]:
    """Turn signals into exceptions that end the work.

    An interrupt during a destructor or a callback, such as those after each import, is repeated: Python cannot raise it
    there, but would print "Exception ignored in" and continue the work.
    """
    former = sys.unraisablehook
    repeats: list[threading.Timer] = []

    def hook(lost: "sys.UnraisableHookArgs") -> None:
        if not isinstance(lost.exc_value, KeyboardInterrupt | Ended):
            former(lost)
            return
        number = lost.exc_value.number if isinstance(lost.exc_value, Ended) else signal.SIGINT
        repeats.append(threading.Timer(PAUSE, _thread.interrupt_main, [number]))  # raised here, it would be lost again
        repeats[-1].daemon = True
        repeats[-1].start()

    handlers = _install()
    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = former
        for repeat in repeats:
            repeat.cancel()
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _install() -> dict[int, signal.Handlers]:
    """Handle the signals whose handlers are still Python's own; return these handlers.

    Background jobs of a shell ignore SIGINT, jobs under nohup ignore SIGHUP, and a program that runs this one may have
    handlers of its own; these are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    own: dict[int, object] = {signal.SIGINT: signal.default_int_handler, **dict.fromkeys(ENDINGS, signal.SIG_DFL)}
    replaced = {number: handler for number, handler in own.items() if signal.getsignal(number) is handler}
    for number in replaced:
        signal.signal(number, _handle)
    return replaced  # type: ignore[return-value]


def _handle(number: int, frame: FrameType | None) -> None:
    """Raise an exception; during an import, whose code could replace it, end the process."""
    files = sys.modules.get("nlfilter_torch.io.photographs")
    if _importing(frame) and not getattr(files, "unfinished", None):
        if sys.stderr.isatty():
            sys.stderr.write(SHOW_CURSOR)  # a progress bar hides it
        if number == signal.SIGINT:
            tell()
        sys.stderr.flush()
        os._exit(128 + number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise Ended(number)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
