"""How threads of OpenMP wait for each other in this program; set before torch is loaded, which reads it then.

By default a thread spins for milliseconds until the others are done. Beside busy processes it spends its share of a
core on waiting, while the thread that it waits for has none: edits take up to twenty times as long. If threads sleep at
once, an idle machine takes up to 1.4 times as long, since an edit divides thousands of short operations. So threads
spin for as long as it takes to wake one, and then sleep (measured by ``benchmarks.busy``). A library cannot set this,
since its user may have loaded torch before.
"""

import os

#: Variables of the environment by which users say how threads wait: those of the standard, GCC and LLVM.
VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")

#: How often a thread of GCC's OpenMP looks whether the others are done before it sleeps; about 10 microseconds.
SPINS = 600


def sleep_while_waiting() -> None:
    """Let threads that have nothing to do sleep soon, in this process and its workers, unless the user decided."""
    if not any(name in os.environ for name in VARIABLES):
        os.environ["OMP_WAIT_POLICY"] = "passive"  # for other implementations of OpenMP
        os.environ["GOMP_SPINCOUNT"] = str(SPINS)  # which takes precedence in GCC's
