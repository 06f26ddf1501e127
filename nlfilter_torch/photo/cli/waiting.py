"""How threads of OpenMP wait for each other in this program; set before torch is loaded, which reads it then.

By default a thread spins for milliseconds until the others are done. Beside busy processes it spends its share of a
core on waiting, while the thread that it waits for has none: edits take up to twenty times as long. A library cannot
set this, since its user may have loaded torch before.
"""

import os

#: Variables of the environment by which users say how threads wait: those of the standard, GCC and LLVM.
VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def sleep_while_waiting() -> None:
    """Let threads that have nothing to do sleep at once, in this process and its workers, unless the user decided."""
    if not any(name in os.environ for name in VARIABLES):
        os.environ["OMP_WAIT_POLICY"] = "passive"
