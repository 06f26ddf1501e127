"""Fig. 18: abstraction."""

from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.figures.scenes import SIDE, SIZE, Numbers, scene
from nlfilter_torch import abstract
from nlfilter_torch.edits.abstract import edge_lines, quantize
from nlfilter_torch.edits.chroma import merge_luminance, split_luminance
from nlfilter_torch.pictures import show_images

TONES, LINES = 8, 0.8
ROUNDS, RANGE, SPREAD = 4, 0.08, 3.0  # of the iterated bilateral filter


def figure_18(size: int = SIZE) -> tuple[Figure, Numbers]:
    """W^k y with k = 0.1 (b), with lines and tones (c), and the same lines and tones after a bilateral filter (d).

    (d) is the method of the paper's [30].
    """
    image = scene("astronaut", size)[0]
    panels = {
        "(a) photograph": image,
        "(b) k = 0.1": abstract(image),
        "(c) with lines and tones": abstract(image, edges=LINES, tones=TONES),
        "(d) bilateral, lines and tones": winnemoeller(image),
    }
    return show_images(panels, columns=2, side=SIDE), {"tones": TONES, "lines": LINES}


def winnemoeller(image: Tensor) -> Tensor:
    """The paper's [30]: a bilateral filter, four times over, then lines and tones."""
    from kornia.filters import bilateral_blur

    flat = image
    for _ in range(ROUNDS):
        flat = bilateral_blur(flat, (13, 13), RANGE, (SPREAD, SPREAD))
    bright, chroma = split_luminance(flat)
    toned = quantize(bright, TONES) * (1 - LINES * (1 - edge_lines(bright, 1.0)))
    return merge_luminance(toned, chroma)
