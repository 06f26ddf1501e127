"""Ctrl-C, SIGTERM and SIGHUP end the program without a traceback or an unfinished file, and set the exit status.

This module is imported first, since other imports take time.
"""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 128 + signal.SIGINT  # exit status that shells use for Ctrl-C
PAUSE = 0.05  # seconds after which an interrupt is sent again, if it could not be raised where it arrived
SHOW_CURSOR = "\x1b[?25h"
ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class Ended(SystemExit):
    """SIGTERM or SIGHUP, raised in the main thread so that unfinished files are removed."""

    def __init__(self, number: int) -> None:
        """Set the exit status that shells use for signal ``number``."""
        self.number, self.status = number, 128 + number
        super().__init__(self.status)


def tell() -> int:
    """Report the interrupt and return the exit status."""
    sys.stderr.write("nlfilter-torch: interrupted; no file is half written\n")
    return INTERRUPTED


@contextmanager
def handled() -> Iterator[None]:
    """Turn signals into exceptions that end the program.

    An interrupt during a destructor or a callback, such as those after each import, is sent again later: Python cannot
    raise it there, but would print "Exception ignored in" and continue. An interrupt during an import while a file is
    unfinished is sent again too: the imported code could catch the exception.
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
        repeat(number)  # an exception raised here would be lost again

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
    """Send a signal to the main thread, even while it waits in a system call if the platform supports that."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


def _install(repeat: Callable[[int], None]) -> dict[int, signal.Handlers]:
    """Replace the handlers of signals that still have Python's own, and return the former handlers.

    Background jobs of a shell ignore SIGINT, jobs under nohup ignore SIGHUP, and a program that runs this one may have
    its own handlers; those are left unchanged.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    own: dict[int, object] = {signal.SIGINT: signal.default_int_handler, **dict.fromkeys(ENDINGS, signal.SIG_DFL)}
    replaced = {number: handler for number, handler in own.items() if signal.getsignal(number) is handler}
    for number in replaced:
        signal.signal(number, lambda number, frame: _handle(number, frame, repeat))
    return replaced  # type: ignore[return-value]


def _handle(number: int, frame: FrameType | None, repeat: Callable[[int], None]) -> None:
    """Raise an exception; during an import, which could catch it, end the process or send the signal again later."""
    files = sys.modules.get("nlfilter_torch.photo.io.writing")
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
    """Whether the command line is importing a module; it may itself be run by an import."""
    while frame is not None and frame.f_globals.get("__name__") != "nlfilter_torch.photo.cli":
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
