"""How well spots are healed beside other methods: ``python -m benchmarks.healing``.

Discs of 5 and of 10 pixels radius at random places of photographs, those of a folder or scikit-image's, are hidden and
filled. ``--out`` writes the discs side by side. The table has for each radius

error    root mean square difference from what was hidden, in grey levels, mean over discs; a perfect texture in other
         places has 1.4 times the error of none;
texture  contrast finer than 1.5 pixels of the filling, relative to that of what was hidden, median over discs.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.restoration import inpaint_biharmonic
from torch import Tensor

from benchmarks.harness import options, row
from benchmarks.photographs import pictures
from nlfilter_torch.photo import Photograph, heal, write_photograph

NAMES = ("astronaut", "coffee", "chelsea", "rocket")
RADII = (5, 10)
AROUND = 8  # radii of the disc to the border of what the methods see
FINE = 1.5  # pixels


def by_opencv(method: int, image: Tensor, spot: Tensor) -> Tensor:
    """A method of OpenCV."""
    stored = (_array(image) * 255).round().astype(np.uint8)
    filled = cv2.inpaint(stored, spot[0, 0].numpy().astype(np.uint8), 5, method)
    return torch.from_numpy(filled).permute(2, 0, 1)[None] / 255


def biharmonic(image: Tensor, spot: Tensor) -> Tensor:
    """That of scikit-image."""
    filled = inpaint_biharmonic(_array(image), spot[0, 0].numpy() > 0, channel_axis=-1)
    return torch.from_numpy(filled).permute(2, 0, 1)[None].float()


METHODS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "heal": heal,
    "biharmonic": biharmonic,
    "OpenCV, Telea": partial(by_opencv, cv2.INPAINT_TELEA),
    "OpenCV, Navier-Stokes": partial(by_opencv, cv2.INPAINT_NS),
}


def _array(image: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = image[0].permute(1, 2, 0).numpy()
    return array


def measured(image: Tensor, filled: Tensor, spot: Tensor) -> tuple[float, float]:
    """The error of a filled spot, and its texture."""
    inside = spot[0, 0] > 0
    error = 255 * float((filled - image)[..., inside].square().mean().sqrt())
    fine = [gray - gaussian_filter(gray, FINE) for gray in (picture[0].mean(0).numpy() for picture in (filled, image))]
    own, wanted = (float(part[inside.numpy()].std()) for part in fine)
    return error, own / max(wanted, 1e-4)


def main() -> None:
    """Measure and print."""
    parser = options("healing", __doc__)
    parser.add_argument("--pictures", type=Path, help="folder of photographs")
    parser.add_argument("--side", type=int, default=1000, help="pixels of the short side")
    parser.add_argument("--discs", type=int, default=4, help="discs of each size in a photograph")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for the discs: hidden, then by each method")
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.first_seed)
    images = pictures(arguments.pictures, arguments.side, NAMES)
    table: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for name, image in images.items():
        for radius in RADII:
            shown = []
            for _ in range(arguments.discs):
                y, x = (int(random.integers(4 * radius, length - 4 * radius)) for length in image.shape[-2:])
                rows, columns = (slice(max(0, place - AROUND * radius), place + AROUND * radius) for place in (y, x))
                down, across = torch.meshgrid(*map(torch.arange, image.shape[-2:]), indexing="ij")
                part, spot = (
                    planes[..., rows, columns]
                    for planes in (image, ((down - y) ** 2 + (across - x) ** 2 <= radius**2).float()[None, None])
                )
                filled = {method: fill(part, spot).clamp(0, 1) for method, fill in METHODS.items()}
                for method, result in filled.items():
                    table.setdefault((method, radius), []).append(measured(part, result, spot))
                views = [part, torch.where(spot > 0, torch.tensor([1.0, 0.0, 1.0]).view(1, 3, 1, 1), part)]
                shown.append(torch.cat([*views, *filled.values()], dim=3))
            if arguments.out is not None:
                arguments.out.mkdir(parents=True, exist_ok=True)
                for number, view in enumerate(shown):
                    write_photograph(Photograph(view), arguments.out / f"{name}-{radius}-{number}.png")
    print(f"{len(images)} photographs, {arguments.discs} discs of each size: error, texture of each radius")
    for method in METHODS:
        values = [torch.tensor(table[method, radius]) for radius in RADII]
        cells = [cell for v in values for cell in (f"{float(v[:, 0].mean()):.1f}", f"{float(v[:, 1].median()):.2f}")]
        print(row(method, cells, 12, 24), flush=True)


if __name__ == "__main__":
    main()
