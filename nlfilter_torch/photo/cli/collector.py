"""How often Python looks for objects that refer to each other in circles; set before torch is loaded.

Torch and what it needs are hundreds of thousands of objects that stay until the program ends. By default Python looks
at them several times while they are loaded, and once more at the end: 0.7 s, a third of the time of a small edit.
No command waits for it, since pixels are freed as soon as they are no longer used; the editor sets it back.
"""

import atexit
import gc
from functools import cache

#: Objects, and multiples, after which Python looks at the youngest, the younger and all objects; 700, 10 and 10 before.
THRESHOLDS = (20_000, 20, 100)


@cache
def collect_seldom() -> None:
    """Look for circles less often in this process, and no longer at its end."""
    gc.set_threshold(*THRESHOLDS)
    atexit.register(gc.freeze)  # what is frozen is not looked at
