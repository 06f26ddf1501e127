"""A number of landmarks that chooses itself: more of them where they cover points badly, up to a limit."""

import math
from collections.abc import Callable
from typing import TypeVar

from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.options import FIRST

WANTED = 0.03  # share of badly covered points that is reached
AIMED = 0.025  # share in a trial, whose balancing of some points alone makes an error of up to half a per cent
MOST = 1000  # landmarks; more take gigabytes for a megapixel, and time that grows with the square
LEAST_GROWTH, MOST_GROWTH = 1.2, 2.0  # of the number, from one trial to the next
SLOWEST, FASTEST = 0.3, 2.0  # powers of the number with which the share is assumed to fall
TRIED = 8192  # points that a trial balances

T = TypeVar("T")


def cover(trial: Callable[[int], tuple[float, T]], points: int) -> T:
    """Try growing numbers of landmarks until the share of badly covered points is small; warn if it never is.

    Args:
        trial: takes a number of landmarks; returns the share that they cover badly, and anything else.
        points: number of points that landmarks may be made of.

    Returns:
        What the last trial returned beside the share. The numbers follow the power law through the last two shares, so
        that few trials are needed, and grow at most twofold, or as much as even the fastest fall demands, so that few
        landmarks are superfluous.
    """
    limit, power = min(MOST, points), 1.0
    count = min(FIRST, limit)
    share, result = trial(count)
    while share > AIMED and count < limit:
        ratio = share / AIMED
        growth = min(max(ratio ** (1 / power), LEAST_GROWTH), max(ratio ** (1 / FASTEST), MOST_GROWTH))
        before, fewer = share, count
        count = min(limit, 8 * round(growth * count / 8))
        share, result = trial(count)
        fallen = math.log(before / max(share, WANTED / 4)) / math.log(count / fewer)
        power = min(max(fallen, SLOWEST), FASTEST)
    if share > WANTED and count < points:
        warn(
            f"num_landmarks='auto' must cover all but {WANTED:.0%} of the points, got {share:.1%} that are badly "
            f"covered with {count}, the most that it chooses; pass more, or a larger bandwidth"
        )
    return result
