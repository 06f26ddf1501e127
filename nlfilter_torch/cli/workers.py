"""How a worker process of ``nlfilter-torch batch`` begins, before it imports anything that takes time."""

import os
import signal
import threading
import time

import psutil

PAUSE = 0.5  # seconds between two looks at the main process


def be_worker(parent: int) -> None:
    """Leave signals to the process of number ``parent``, and end when it does."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    # A worker would not notice that the main process was killed, and would wait for ever.
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent and psutil.pid_exists(parent):  # the first on POSIX, the second on Windows
        time.sleep(PAUSE)
    os._exit(1)
