"""What lighter shadows and darker highlights cost in contrast and halos: ``python -m benchmarks.shading``.

``shadows`` 0.7 and ``highlights`` -0.7 of ``develop``, on the areas that the filter finds, beside the same two curves
on the tones of single pixels, on areas of a guided filter, and on a Gaussian blur. Photographs are those of a folder,
or scikit-image's, reduced to a short side of ``--side`` pixels. ``--out`` writes the pictures side by side. The
table has the mean over photographs, in grey levels:

lift     change of the mean luminance of dark areas (a blur of luminance is below 0.3), and of light ones (above 0.7);
detail   contrast finer than 3 pixels in these areas, as a share of that before;
halo     gradient of the change, over 10 pixels, on smooth ground 3 to 16 pixels beside the 3 % of steepest edges.
"""

from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from kornia.filters import guided_blur
from torch import Tensor

from benchmarks.enhancers import gaussian
from benchmarks.harness import options, row
from benchmarks.photographs import luminance, pictures
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.picture.light import develop_image, shaded
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph

NAMES = (
    "hubble_deep_field",
    "immunohistochemistry",
    "retina",
    "colorwheel",
    "astronaut",
    "coffee",
    "chelsea",
    "rocket",
)
VALUES = Development(shadows=0.7, highlights=-0.7)
DARK, LIGHT, BLUR = 0.3, 0.7, 8.0
STEEP, NEAR, FAR, SMOOTH = 0.03, 3, 16, 1 / 255  # edges, pixels from them, and the gradient of smooth ground
LEVELS, WIDTH = 40 / 255, 1 / 16  # of the guided filter: difference that is an edge, and radius as a share of the side


def on_areas(areas: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """The edit of an image by the same curves on other areas (1, 1, H, W) of its luminance."""
    return lambda image: (image + shaded(areas(luminance(image)).clamp(0, 1), VALUES)).clamp(0, 1)


def guided(grey: Tensor) -> Tensor:
    """Areas of a guided filter."""
    width = 2 * round(WIDTH * min(grey.shape[-2:])) + 1
    return guided_blur(grey, grey, width, LEVELS**2)


METHODS: dict[str, Callable[[Tensor], Tensor]] = {
    "develop": lambda image: develop_image(image, VALUES),
    "curve": on_areas(lambda grey: grey),
    "guided filter": on_areas(guided),
    "Gaussian": on_areas(lambda grey: gaussian(grey, WIDTH * min(grey.shape[-2:]) / 2)),
}


def slope(planes: Tensor) -> Tensor:
    """Length of the gradient (1, 1, H, W)."""
    padded = F.pad(planes, (1, 1, 1, 1), mode="replicate")
    across, down = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    return (across.square() + down.square()).sqrt() / 2


def around(places: Tensor, distance: int) -> Tensor:
    """Places (1, 1, H, W) within a distance in pixels, along rows and columns."""
    return F.max_pool2d(places.float(), 2 * distance + 1, 1, distance) > 0


def measured(image: Tensor, edited: Tensor) -> list[float]:
    """The numbers of a row, for a photograph (1, 3, H, W)."""
    grey, after = luminance(image), luminance(edited)
    blurred, change = gaussian(grey, BLUR), after - grey
    dark, light = blurred < DARK, blurred > LIGHT
    fine = [(plane - gaussian(plane, 3.0)).abs() for plane in (grey, after)]
    steep = slope(gaussian(grey, 1.0))
    edges = steep > steep.flatten().quantile(1 - STEEP)
    beside = around(edges, FAR) & ~around(edges, NEAR) & (slope(gaussian(grey, 2.0)) < SMOOTH)
    toned = dark | light
    return [
        *(255 * float(change[places].mean()) for places in (dark, light)),
        float(fine[1][toned].mean() / fine[0][toned].mean()),
        2550 * float(slope(gaussian(change, 2.0))[beside].mean()),
    ]


def main() -> None:
    """Measure and print."""
    parser = options("shading", __doc__)
    parser.add_argument("--pictures", type=Path, help="folder of photographs")
    parser.add_argument("--side", type=int, default=400, help="pixels of the short side")
    parser.add_argument("--out", type=Path, help="folder for the original and the results side by side")
    arguments = parser.parse_args()
    images = pictures(arguments.pictures, arguments.side, NAMES)
    table: dict[str, list[list[float]]] = {name: [] for name in METHODS}
    for name, image in images.items():
        results = {method: edit(image).clamp(0, 1) for method, edit in METHODS.items()}
        for method, edited in results.items():
            table[method].append(measured(image, edited))
        if arguments.out is not None:
            arguments.out.mkdir(parents=True, exist_ok=True)
            write_photograph(Photograph(torch.cat([image, *results.values()], dim=3)), arguments.out / f"{name}.png")
    print(f"{len(images)} photographs; lift of dark and of light areas, detail, halo")
    for method, rows in table.items():
        print(row(method, (f"{value:.2f}" for value in torch.tensor(rows).nanmean(0).tolist())))


if __name__ == "__main__":
    main()
