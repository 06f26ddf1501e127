"""The pictures of docs/: ``python -m docs.guide_pictures [FOLDER] [--only NAME,...]``; prints their figures.

Each function makes one picture, at the original size of the photograph; its docstring describes what to look at.
"""

import argparse
import inspect
from pathlib import Path

import torch
from kornia.color import rgb_to_grayscale
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.photographs import photograph
from docs.scenes import LETTERS
from nlfilter_torch import (
    captured_energy,
    detail_layers,
    diffusion_mask,
    estimate_bandwidth,
    nonlocal_operator,
    polynomial_filter,
)
from nlfilter_torch.photo import (
    PRESETS,
    abstract,
    adjust_tone,
    apply_recipe,
    colorize,
    defocus,
    denoise,
    enhance,
    recolor,
    sharpen,
)
from nlfilter_torch.photo.files.writing import open_beside
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.plotting import plot_response, show_eigenvectors, show_images, show_layers

ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05])
LEVELS = 255.0
FACE, WHISKERS = (20, 130, 250), (60, 110, 240)  # top, left and side of the part that is shown
MANY = 1000  # landmarks of the reference
SUIT = (slice(150, 160), slice(30, 40))  # square on the astronaut's suit, at half size


def crop(image: Tensor, window: tuple[int, int, int]) -> Tensor:
    """Cut out the part of an image that is shown."""
    top, left, side = window
    return image[..., top : top + side, left : left + side]


def filtered(image: Tensor, alpha: Tensor = ALPHA, **options: object) -> Tensor:
    """Apply sliders to a photograph, keeping its colours."""
    operator = nonlocal_operator(rgb_to_grayscale(image), **options)  # type: ignore[arg-type]
    return edit_luminance(image, lambda planes: polynomial_filter(operator, planes, alpha))


def presets(name: str, window: tuple[int, int, int]) -> Figure:
    """Every preset on one photograph."""
    image = photograph(name)
    panels = {"before": image} | {title: apply_recipe(preset, image) for title, preset in PRESETS.items()}
    return show_images(
        {title: crop(panel, window) for title, panel in panels.items()}, columns=3, side=250, letters=LETTERS
    )


def presets_portrait() -> Figure:
    """Every preset on a portrait: look at the skin, the hair and the cloth of the suit."""
    return presets("astronaut", FACE)


def presets_fur() -> Figure:
    """Every preset on fur: look at the hairs between the eyes, the whiskers and the dark of the pupils."""
    return presets("chelsea", WHISKERS)


def bandwidth() -> Figure:
    """Photometric bandwidth: the finest layer (top), and the photograph edited with the same sliders (bottom).

    With a small bandwidth, the finest layer has only the grain; with a large one, layers have edges and shading too,
    and the sliders change contrast.
    """
    image = photograph("chelsea")
    luminance = rgb_to_grayscale(image)
    auto = LEVELS * float(estimate_bandwidth(luminance))
    finest, edited = {}, {}
    for levels in (4.0, auto, 30.0, 60.0):
        operator = nonlocal_operator(luminance, photometric_bandwidth=levels / LEVELS)
        title = f"{levels:.0f} levels" + (", auto" if levels == auto else "")
        beta = captured_energy(operator.spectrum(), luminance).item()
        finest[f"{title}, beta {beta:.4f}"] = 0.5 + 4 * detail_layers(operator, luminance)[0, 0]
        edited[title] = edit_luminance(image, lambda planes, w=operator: polynomial_filter(w, planes, ALPHA))
        print(f"bandwidth {levels:.1f}: beta {beta:.4f}")
    panels = {title: crop(panel, WHISKERS) for title, panel in (finest | edited).items()}
    return show_images(panels, columns=4, side=240)


def patch_size() -> Figure:
    """Patch size: single pixels give nearly a tone curve; larger patches separate texture from shading."""
    image = photograph("chelsea")
    panels = {"before": image}
    for size in (1, 5, 11):
        panels[f"patches of {size}x{size}"] = filtered(image, patch_size=size)
    return show_images({title: crop(panel, WHISKERS) for title, panel in panels.items()}, columns=4, side=240)


def landmarks() -> Figure:
    """Landmarks from k-means and on a grid: difference from a filter with a thousand landmarks, amplified ten times."""
    luminance = rgb_to_grayscale(photograph("chelsea", 160, 240))
    options = {"photometric_bandwidth": estimate_bandwidth(luminance)}
    truth = polynomial_filter(nonlocal_operator(luminance, num_landmarks=MANY, **options), luminance, ALPHA)
    panels = {}
    for sampling in ("kmeans", "uniform"):
        for count in (10, 30, 100, 300):
            operator = nonlocal_operator(luminance, num_landmarks=count, landmarks=sampling, **options)  # type: ignore[arg-type]
            error = polynomial_filter(operator, luminance, ALPHA) - truth
            levels = LEVELS * float(error.square().mean().sqrt())
            print(f"{sampling}, {count} landmarks: {levels:.2f} levels RMS from {MANY}")
            panels[f"{sampling}, {count}: {levels:.2f} levels"] = 0.5 + 10 * error
    return show_images(panels, columns=4, side=240)


def _suit() -> tuple[Tensor, Tensor]:
    image = photograph("astronaut", 256, 256)
    region = torch.zeros_like(image[:, :1])
    region[..., SUIT[0], SUIT[1]] = 1
    return image, region


def spatial_bandwidth() -> Figure:
    """Spatial bandwidth: the mask of a square on the suit for none, a fifth and a twelfth of the short side."""
    image, region = _suit()
    panels = {"the spot": image * (1 - region) + region}
    for pixels in (None, 51.0, 21.0):
        operator = nonlocal_operator(
            image, photometric_bandwidth=25 / LEVELS, guide_channels="all", spatial_bandwidth=pixels
        )
        title = "no spatial bandwidth" if pixels is None else f"{pixels:.0f} pixels"
        panels[title] = diffusion_mask(operator.spectrum(), region)
    return show_images(panels, columns=4, side=256)


def time_and_width() -> Figure:
    """Diffusion time (down) and width (across) of the mask of a square on the suit."""
    image, region = _suit()
    spectrum = nonlocal_operator(image, photometric_bandwidth=25 / LEVELS, guide_channels="all").spectrum()
    panels = {}
    for time in (0.5, 1.0, 3.0, 10.0):
        for width in (1.0, 4.0, 16.0):
            mask = diffusion_mask(spectrum, region, time=time, width=width)
            panels[f"time {time:g}, width {width:g}"] = mask
            print(f"time {time:g}, width {width:g}: {100 * float((mask > 0.5).float().mean()):.1f} % above 1/2")
    return show_images(panels, columns=3, side=192)


def single_sliders() -> Figure:
    """One slider at a time: the layer times three (top), and without the layer (bottom)."""
    image = photograph("chelsea")
    operator = nonlocal_operator(rgb_to_grayscale(image))
    panels = {}
    for value in (3.0, 0.0):
        for number in range(3):
            alpha = torch.ones(4)
            alpha[number] = value
            title = f"({', '.join(f'{a:g}' for a in alpha.tolist())})"
            panels[title] = edit_luminance(image, lambda planes, a=alpha: polynomial_filter(operator, planes, a))
    return show_images(
        {title: crop(panel, WHISKERS) for title, panel in panels.items()}, columns=3, side=240, letters=LETTERS
    )


def edits() -> Figure:
    """The edits, on one photograph of 300x200 pixels, with two scribbles on the saucer and five on the cup."""
    image = photograph("coffee", 200, 300)
    saucer, cup = torch.zeros_like(image[:, :1]), torch.zeros_like(image[:, :1])
    saucer[..., 106:122, 52:68], saucer[..., 112:124, 218:232], cup[..., 60:74, 92:98] = 1, 1, 1
    cup[..., 96:103, 120:150] = cup[..., 76:88, 120:150] = cup[..., 35:60, 110:116] = cup[..., 112:120, 112:150] = 1
    wood = torch.zeros_like(saucer)
    for top, left in ((20, 60), (5, 100), (50, 250), (130, 270), (185, 20), (54, 140), (75, 145)):
        wood[..., top : top + 10, left : left + 10] = 1
    blue = torch.tensor([0.1, 0.2, 0.8]).view(1, 3, 1, 1).expand_as(image)
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0)) * 20 / LEVELS
    grey = rgb_to_grayscale(image)
    painted = torch.zeros_like(grey)
    painted[..., 10::45, 10::45] = 1
    painted = torch.nn.functional.max_pool2d(painted, 5, 1, 2)
    panels = {
        "before": image,
        "detail --region, on the saucer": enhance(image, torch.tensor([4.0, 4.0, 4.0, 1.0]), saucer),
        "sharpen": sharpen(image),
        "tone --contrast 1.3": adjust_tone(image, contrast=1.3),
        "recolor the saucer, keep wood": recolor(image, blue, saucer, keep=wood),
        "grey, with dots of colour": torch.lerp(grey.expand_as(image), image, painted),
        "colorize": colorize(grey, image, painted),
        "defocus, but for the cup": defocus(image, cup, radius=4.0),
        "abstract": abstract(image),
        "abstract --edges 1 --tones 8": abstract(image, edges=1.0, tones=8, photometric_bandwidth=50 / LEVELS),
        "with noise of 20 levels": image + noise,
        "denoise": denoise(image + noise),
    }
    return show_images(panels, columns=3, side=260, letters=LETTERS)


def layers() -> Figure:
    """The layers of a photograph, which sum to it."""
    luminance = rgb_to_grayscale(photograph("chelsea"))
    return show_layers(detail_layers(nonlocal_operator(luminance), luminance), side=400)


def eigenvectors() -> Figure:
    """Eigenvectors: large areas first, edges and texture later."""
    luminance = rgb_to_grayscale(photograph("chelsea"))
    return show_eigenvectors(nonlocal_operator(luminance).spectrum(), (2, 3, 5, 10, 20, 40), side=270)


def response() -> Figure:
    """The response of the sliders to eigenvalues."""
    luminance = rgb_to_grayscale(photograph("chelsea"))
    return plot_response(ALPHA, nonlocal_operator(luminance).spectrum())


PICTURES = {
    "presets-portrait": presets_portrait,
    "presets-fur": presets_fur,
    "bandwidth": bandwidth,
    "patch-size": patch_size,
    "landmarks": landmarks,
    "spatial-bandwidth": spatial_bandwidth,
    "time-and-width": time_and_width,
    "single-sliders": single_sliders,
    "edits": edits,
    "layers": layers,
    "eigenvectors": eigenvectors,
    "response": response,
}


def main(arguments: list[str] | None = None) -> None:
    """Write the pictures as JPEG files, and print what to look at."""
    parser = argparse.ArgumentParser(description="Write the pictures of the documentation.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs/pictures"), help="folder for the pictures")
    parser.add_argument("--only", metavar="NAMES", help=f"some of {', '.join(PICTURES)}, separated by commas")
    options = parser.parse_args(arguments)
    chosen = options.only.split(",") if options.only else list(PICTURES)
    unknown = [name for name in chosen if name not in PICTURES]
    if unknown:
        parser.error(f"--only must name pictures among {', '.join(PICTURES)}, got {', '.join(unknown)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in chosen:
        path = options.folder / f"{name}.jpg"
        with torch.no_grad(), open_beside(path) as stream:
            PICTURES[name]().savefig(stream, format="jpeg", pil_kwargs={"quality": 88})
        print(f"{path}: {inspect.getdoc(PICTURES[name])}\n")


if __name__ == "__main__":
    main()
