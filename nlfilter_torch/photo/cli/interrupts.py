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
from importlib.machinery import SourceFileLoader
from types import FrameType, ModuleType

INTERRUPTED = 128 + signal.SIGINT  # exit status that shells use for Ctrl-C
PAUSE = 0.05  # seconds after which an interrupt is sent again, if it could not be raised where it arrived
SHOW_CURSOR = "\x1b[?25h"
ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))

Handler = Callable[[int, FrameType | None], object] | int | None


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


class _Imports(threading.local):
    """Number of modules that the calling thread is importing, one within the other."""

    running = 0


_imports = _Imports()


def _exec_module(loader: SourceFileLoader, module: ModuleType) -> None:
    """Run the code of a module, and count it among the running imports meanwhile."""
    _imports.running += 1
    try:
        super(SourceFileLoader, loader).exec_module(module)
    finally:
        _imports.running -= 1


@contextmanager
def _counting_imports() -> Iterator[None]:
    """Count the modules that are being imported; those begun earlier do not count, since they may run this program."""
    before, _imports.running = _imports.running, 0
    own = "exec_module" in vars(SourceFileLoader)  # counted already: the program runs itself
    if not own:
        setattr(SourceFileLoader, "exec_module", _exec_module)  # noqa: B010  # mypy refuses to assign to a method
    try:
        yield
    finally:
        _imports.running = before
        if not own:
            delattr(SourceFileLoader, "exec_module")


@contextmanager
def handled() -> Iterator[None]:
    """Turn signals into exceptions that end the program.

    An interrupt during a destructor or a callback, such as those after each import, is sent again later: Python cannot
    raise it there, but would print "Exception ignored in" and continue. An interrupt during an import while a file is
    unfinished is sent again too: the imported code could catch the exception.
    """
    signals = _Signals()
    with _counting_imports():
        signals.install()
        try:
            yield
        finally:
            signals.restore()


class _Signals:
    """The handlers of signals, which replace Python's own for a while."""

    def __init__(self) -> None:
        self._unraisablehook = sys.unraisablehook
        self._repeats: list[threading.Timer] = []
        self._handlers: dict[int, Handler] = {}

    def install(self) -> None:
        """Replace the handlers of signals that still have Python's own.

        Background jobs of a shell ignore SIGINT, jobs under nohup ignore SIGHUP, and a program that runs this one may
        have its own handlers; those are left unchanged.
        """
        if threading.current_thread() is threading.main_thread():
            usual: dict[int, Handler] = {
                signal.SIGINT: signal.default_int_handler,
                **dict.fromkeys(ENDINGS, signal.SIG_DFL),
            }
            self._handlers = {
                number: handler for number, handler in usual.items() if signal.getsignal(number) is handler
            }
            for number in self._handlers:
                signal.signal(number, self._handle)
        sys.unraisablehook = self._hook

    def restore(self) -> None:
        """Restore Python's handlers."""
        sys.unraisablehook = self._unraisablehook
        for timer in self._repeats:
            timer.cancel()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        """Raise an exception.

        During an import, which could catch it, end the process, or send the signal again later if a file is unfinished.
        """
        files = sys.modules.get("nlfilter_torch.photo.files.writing")
        if _imports.running > 0:
            if getattr(files, "unfinished", None):
                self._repeat(number)
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

    def _hook(self, lost: "sys.UnraisableHookArgs") -> None:
        if not isinstance(lost.exc_value, KeyboardInterrupt | Ended):
            self._unraisablehook(lost)
            return
        number = lost.exc_value.number if isinstance(lost.exc_value, Ended) else signal.SIGINT
        self._repeat(number)  # an exception raised here would be lost again

    def _repeat(self, number: int) -> None:
        """Send a signal again later."""
        timer = threading.Timer(PAUSE, _send, [number])
        timer.daemon = True
        self._repeats.append(timer)
        timer.start()


def _send(number: int) -> None:
    """Send a signal to the main thread, even while it waits in a system call if the platform supports that."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:
        _thread.interrupt_main(signal.Signals(number))
