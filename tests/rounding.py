"""How far sums in floating point may differ that are the same but for their order."""

import torch

from nlfilter_torch.nn.denoiser.network import AFTER, BEFORE, PASSES, WIDTH

#: How many times larger one rounding error may be than another of the same sums in another order, as both are random:
#: the largest of a few pixels is a third of that of many, and both the kernels and their definitions have few at times.
SPREAD = 4


def rounding(terms: int, size: float = 1.0, dtype: torch.dtype = torch.float32) -> float:
    """Return the largest difference to expect between two sums of so many terms that are added in different orders.

    Processors, numbers of threads and sizes of a batch divide sums differently. Each addition rounds by at most eps/2
    of the partial sum. Rounding errors are as good as independent, so that the error of a sum of n terms stays below
    4 eps/2 sqrt(n) times the sum of their magnitudes (``size``), but for a chance of 1e-3 (Higham and Mary, A new
    approach to probabilistic rounding error analysis, 2019); the difference of two such sums stays below twice that.
    Of a chain of sums, such as the layers of a network, ``terms`` is the total on the way to a result.
    """
    return 4 * torch.finfo(dtype).eps * terms**0.5 * size


def denoiser_rounding(level: float) -> float:
    """Return the difference to expect of two calls of the trained denoiser for the same pixels.

    ``level`` is the standard deviation of their noise; the largest values that the network computes are 4 times that.
    """
    layers = len(BEFORE) + len(AFTER) + 4  # and the first, the guide's, the joining and the last
    return rounding(PASSES * layers * 9 * WIDTH, 4 * level)  # 3x3 products of WIDTH channels in each
