"""Ctrl-C, SIGTERM and SIGHUP end the work without a traceback or an unfinished file, and set the exit status.

This module is imported before anything that takes time.
"""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 128 + signal.SIGINT  # exit status, as shells have it for Ctrl-C
PAUSE = 0.05  # seconds until an interrupt is repeated that could not be raised where it arrived
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
    there, but would print "Exception ignored in" and continue the work. So is one during an import while a file is
    unfinished: the imported code could catch the exception.
    """
    former = sys.unraisablehook
    repeats: list[threading.Timer] = []

    def repeat(number: int) -> None:
        repeats.append(threading.Timer(PAUSE, _send, [number]))
        repeats[-1].daemon = True
        repeats[-1].start()

    def hook(lost: "sys.UnraisableHookArgs") -> None:
        if not isinstance(lost.exc_value, KeyboardInterrupt | Ended):
            former(lost)
            return
        number = lost.exc_value.number if isinstance(lost.exc_value, Ended) else signal.SIGINT
        repeat(number)  # raised here, it would be lost again

    handlers = _install(repeat)
    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = former
        for timer in repeats:
            timer.cancel()
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _send(number: int) -> None:
    """Send a signal to the main thread, also while it waits in a system call where the platform can do that."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


def _install(repeat: Callable[[int], None]) -> dict[int, signal.Handlers]:
    """Handle the signals whose handlers are still Python's own; return these handlers.

    Background jobs of a shell ignore SIGINT, jobs under nohup ignore SIGHUP, and a program that runs this one may have
    handlers of its own; these are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    own: dict[int, object] = {signal.SIGINT: signal.default_int_handler, **dict.fromkeys(ENDINGS, signal.SIG_DFL)}
    replaced = {number: handler for number, handler in own.items() if signal.getsignal(number) is handler}
    for number in replaced:
        signal.signal(number, lambda number, frame: _handle(number, frame, repeat))
    return replaced  # type: ignore[return-value]


def _handle(number: int, frame: FrameType | None, repeat: Callable[[int], None]) -> None:
    """Raise an exception; during an import, whose code could catch it, end the process or wait for the import."""
    files = sys.modules.get("nlfilter_torch.io.photographs")
    if _importing(frame):
        if getattr(files, "unfinished", None):
            repeat(number)
            return
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
    """Whether the command line, which may itself be run by an import, is importing something."""
    while frame is not None and frame.f_globals.get("__name__") != "nlfilter_torch.cli":
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
