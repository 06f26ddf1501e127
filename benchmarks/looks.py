"""How much of other programs' edits a fitted look repeats, beside other ways: ``python -m benchmarks.looks``.

Edits by OpenCV, scikit-image and Pillow (and ImageMagick where it is installed) on ten photographs: looks are fitted to
one, three and five of the first five, and judged on the other five. Figures are shares of the energy of the change that
the result explains, in percent, after clipping. Peers are fitted to the same pairs: sliders alone, a curve of 256
values for each channel, a colour table of 17^3 entries (trilinear, with a ridge towards the identity and towards smooth
changes), and histograms matched. Only three of scikit-image's photographs were not used to choose parameters
(``--set reporting``), enough for one pair: figures for several are to be reported on a folder of others. The parameters
of the colour table were not tuned. "Best" is by held-out means as they are printed, and without a tie.

``python -m benchmarks.looks_of_people`` measures edits that stand for those by people.
"""

import io
import shutil
import statistics
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.sparse as sparse
import torch
from numpy.typing import NDArray
from PIL import Image, ImageEnhance, ImageFilter, ImageOps
from scipy.sparse.linalg import cg
from skimage import exposure, filters
from torch import Tensor

from benchmarks.harness import options, row
from benchmarks.photographs import pictures
from nlfilter_torch.photo import fit_look

Bytes = NDArray[np.uint8]
Edit = Callable[[Bytes], Bytes]
Predict = Callable[[Tensor], Tensor]
Pairs = Sequence[tuple[Tensor, Tensor]]
CHOSEN_ON = ("astronaut", "coffee", "chelsea", "rocket", "immunohistochemistry", "retina")
REPORTED_ON = ("hubble_deep_field", "motorcycle", "colorwheel")  # no picture of the others
SIDE = 256
NODES = 17
SMOOTH, RIDGE = 1e-2, 1e-4  # of the colour table; not tuned
SEPIA = np.array([[0.393, 0.769, 0.189], [0.349, 0.686, 0.168], [0.272, 0.534, 0.131]])


def bytes_of(values: NDArray[np.float64]) -> Bytes:
    """In 8 bits."""
    return np.clip(np.rint(values * 255), 0, 255).astype(np.uint8)


def pillow(edit: Callable[[Image.Image], Image.Image]) -> Edit:
    """An edit by Pillow."""
    return lambda rgb: np.array(edit(Image.fromarray(rgb)))


def floats(edit: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Edit:
    """An edit of floats by scikit-image."""
    return lambda rgb: bytes_of(edit(rgb / 255.0))


def magick(*options: str) -> Edit:
    """An edit by ImageMagick."""

    def edit(rgb: Bytes) -> Bytes:
        head = b"P6 %d %d 255\n" % (rgb.shape[1], rgb.shape[0])
        command = [magick_program() or "magick", "ppm:-", *options, "-depth", "8", "ppm:-"]
        done = subprocess.run(command, input=head + rgb.tobytes(), capture_output=True, check=True)
        return np.array(Image.open(io.BytesIO(done.stdout)).convert("RGB"))

    return edit


def magick_program() -> str | None:
    """ImageMagick's program, if there is one that works."""
    for name in ("magick", "convert"):
        if shutil.which(name):
            known = subprocess.run([name, "-version"], capture_output=True, text=True, check=False)
            if known.returncode == 0 and known.stdout.startswith("Version: ImageMagick"):
                return name
    return None


def warm(rgb: Bytes) -> Bytes:
    """More red, less blue."""
    return bytes_of(rgb / 255.0 * np.array([1.15, 1.0, 0.85]))


def mixed(rgb: Bytes) -> Bytes:
    """Brightness, contrast and saturation by Pillow, gamma by scikit-image, warmth by OpenCV."""
    image = Image.fromarray(rgb)
    for kind, factor in ((ImageEnhance.Brightness, 1.1), (ImageEnhance.Contrast, 1.25), (ImageEnhance.Color, 1.3)):
        image = kind(image).enhance(factor)
    bright = bytes_of(exposure.adjust_gamma(np.array(image) / 255.0, 0.9))
    return cv2.transform(bright, np.diag([1.08, 1.0, 0.92]))


def more_saturated(rgb: Bytes) -> Bytes:
    """Saturation in HSV by OpenCV."""
    hsv = cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV).astype(np.float32)
    hsv[..., 1] = np.clip(hsv[..., 1] * 1.4, 0, 255)
    return cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)


def equalized(rgb: Bytes) -> Bytes:
    """CLAHE of lightness by OpenCV."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(2.0, (8, 8)).apply(lab[..., 0].copy())
    return cv2.cvtColor(lab, cv2.COLOR_LAB2RGB)


def detailed(rgb: Bytes) -> Bytes:
    """OpenCV's detailEnhance."""
    return cv2.detailEnhance(rgb[..., ::-1].copy(), sigma_s=10, sigma_r=0.15)[..., ::-1].copy()


EDITS: dict[str, Edit] = {
    "gamma (scikit-image)": floats(lambda x: exposure.adjust_gamma(x, 0.6)),
    "S-curve (scikit-image)": floats(lambda x: exposure.adjust_sigmoid(x, 0.5, 8)),
    "logarithm (scikit-image)": floats(lambda x: exposure.adjust_log(x, 1.0)),
    "saturation (Pillow)": pillow(lambda x: ImageEnhance.Color(x).enhance(1.6)),
    "saturation in HSV (OpenCV)": more_saturated,
    "contrast (Pillow)": pillow(lambda x: ImageEnhance.Contrast(x).enhance(1.4)),
    "automatic contrast (Pillow)": pillow(ImageOps.autocontrast),
    "warmth (NumPy)": warm,
    "sepia (OpenCV)": lambda rgb: cv2.transform(rgb, SEPIA),
    "mixture (all three)": mixed,
    "unsharp (Pillow)": pillow(lambda x: x.filter(ImageFilter.UnsharpMask(2, 150, 0))),
    "unsharp (scikit-image)": floats(lambda x: filters.unsharp_mask(x, radius=3, amount=1, channel_axis=2)),
    "detailEnhance (OpenCV)": detailed,
    "CLAHE (OpenCV)": equalized,
    "CLAHE (scikit-image)": floats(lambda x: exposure.equalize_adapthist(x, clip_limit=0.01)),
}
MAGICK = {
    "sigmoidal contrast (ImageMagick)": magick("-sigmoidal-contrast", "5x40%"),
    "modulate (ImageMagick)": magick("-modulate", "105,130,100"),
    "unsharp (ImageMagick)": magick("-unsharp", "0x2+1.5+0"),
}


def applied(edit: Edit, photograph: Tensor) -> Tensor:
    """A photograph (1, 3, H, W) under an edit."""
    rgb = (photograph[0].permute(1, 2, 0) * 255).round().byte().numpy()
    return torch.from_numpy(np.ascontiguousarray(edit(rgb))).permute(2, 0, 1)[None].float() / 255


def look_of(pairs: Pairs, **parts: Any) -> Predict:
    """The look, or some of its parts."""
    look = fit_look(pairs, **parts)
    assert not isinstance(look, tuple)
    return look.apply


def curves_of(pairs: Pairs) -> Predict:
    """Means of the edited values for each of 256 values of each channel; between them where there are none."""
    tables = []
    for channel in range(3):
        total, count = np.zeros(256), np.zeros(256)
        for before, after in pairs:
            places = (before[0, channel] * 255).round().long().flatten().numpy()
            total += np.bincount(places, after[0, channel].flatten().double().numpy(), 256)
            count += np.bincount(places, None, 256)
        known = count.nonzero()[0]
        tables.append(np.interp(np.arange(256), known, total[known] / count[known]))
    table = torch.from_numpy(np.stack(tables)).float()

    def predict(image: Tensor) -> Tensor:
        places = (image[0] * 255).round().long().flatten(1)
        return table.gather(1, places).view_as(image)

    return predict


def trilinear(image: Tensor, nodes: int = NODES) -> sparse.csr_matrix:
    """Weights (N, n^3) of the entries of a colour table."""
    place = image[0].flatten(1).double().numpy() * (nodes - 1)
    below = np.clip(np.floor(place), 0, nodes - 2).astype(np.int64)
    part, count = place - below, place.shape[1]
    columns, values = [], []
    for corner in np.ndindex(2, 2, 2):
        columns.append(np.ravel_multi_index(tuple(below + np.array(corner)[:, None]), (nodes,) * 3))
        values.append(np.prod([part[i] if corner[i] else 1 - part[i] for i in range(3)], axis=0))
    rows = np.tile(np.arange(count), 8)
    return sparse.csr_matrix((np.concatenate(values), (rows, np.concatenate(columns))), (count, nodes**3))


def table_of(pairs: Pairs, nodes: int = NODES, smooth: float = SMOOTH) -> Predict:
    """A colour table by least squares."""
    line, eye = sparse.diags([-1.0, 1.0], [0, 1], shape=(nodes - 1, nodes)), sparse.identity(nodes)
    kinds = [(line, eye, eye), (eye, line, eye), (eye, eye, line)]
    steps = sparse.vstack([sparse.kron(sparse.kron(a, b), c) for a, b, c in kinds])
    gram, right = sparse.csr_matrix((nodes**3, nodes**3)), np.zeros((nodes**3, 3))
    for before, after in pairs:
        weights = trilinear(before, nodes)
        share = weights.shape[0] * len(pairs) / nodes**3
        gram = gram + weights.T @ weights / share
        right += weights.T @ (after - before)[0].flatten(1).T.double().numpy() / share
    gram = gram + smooth * steps.T @ steps + RIDGE * sparse.identity(nodes**3)
    table = np.stack([cg(gram, right[:, c], rtol=1e-5, maxiter=500)[0] for c in range(3)], axis=1)
    return lambda image: image + torch.from_numpy((trilinear(image, nodes) @ table).T).float().view_as(image)


def histograms_of(pairs: Pairs) -> Predict:
    """Every photograph is given the histograms of the edited ones."""

    def predict(image: Tensor) -> Tensor:
        edited = torch.cat([after[0].flatten(1) for _, after in pairs], dim=1).numpy()
        flat = image[0].flatten(1).numpy()
        result = exposure.match_histograms(flat.T[:, None], edited.T[:, None], channel_axis=2)[:, 0].T
        return torch.from_numpy(np.ascontiguousarray(result)).float().view_as(image)

    return predict


METHODS: dict[str, Callable[[Pairs], Predict]] = {
    "look": look_of,
    "sliders": partial(look_of, parts=("alpha",)),
    "curves": curves_of,
    "17^3 table": table_of,
    "histograms": histograms_of,
}


def explained(before: Tensor, after: Tensor, prediction: Tensor) -> float:
    """Percent of the change's energy."""
    left = (after - prediction.clamp(0, 1)).double().square().sum()
    return 100 * (1 - float(left / (after - before).double().square().sum().clamp(min=1e-12)))


def is_changed(before: Tensor, after: Tensor) -> bool:
    """Whether an edit changes a photograph by a level or more; saturation changes grey ones by rounding only."""
    return float((after - before).square().mean().sqrt()) >= 1 / 255


def shares(predict: Predict, pairs: Pairs) -> list[float]:
    """What is explained of each pair that the edit changes."""
    return [explained(*pair, predict(pair[0])) for pair in pairs if is_changed(*pair)]


def judge(
    fit: Callable[[Pairs], Predict], fitted: Pairs, held: Pairs, *, at_once: bool
) -> tuple[list[float], list[float]]:
    """What is explained of the fitted pairs, and of those that are held out.

    Unless they are fitted ``at_once``, each pair is fitted alone and judged on itself, and the first fit is also judged
    on the held-out pairs.
    """
    if at_once:
        predict = fit(fitted)
        return shares(predict, fitted), shares(predict, held)
    changed = [pair for pair in fitted if is_changed(*pair)]
    predicts = [fit([pair]) for pair in changed]
    own = [share for pair, predict in zip(changed, predicts, strict=True) for share in shares(predict, [pair])]
    return own, shares(predicts[0], held)


def main() -> None:
    """Print the tables."""
    parser = options("looks", __doc__, "four small photographs that parameters were chosen on, and three edits")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of photographs, in place of scikit-image's")
    add("--set", choices=("choosing", "reporting"), default="reporting")
    add("--side", type=int, default=SIDE, help="pixels of the short side")
    add("--seed", type=int, default=0, help="of the order of the photographs")
    add("--counts", type=int, nargs="+", default=[1, 3, 5], help="of pairs that are fitted at once")
    add("--edits", nargs="+", default=[""], help="words of the names of the edits; all by default")
    add("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="all by default")
    chosen = parser.parse_args()
    names = CHOSEN_ON if chosen.set == "choosing" or chosen.quick else REPORTED_ON
    images = pictures(chosen.pictures, 64 if chosen.quick else chosen.side, names)
    order = torch.randperm(len(images), generator=torch.Generator().manual_seed(chosen.seed)).tolist()
    used = [list(images)[i] for i in order][: 4 if chosen.quick else 10]
    edits = EDITS | (MAGICK if magick_program() else {})
    edits = {name: edit for name, edit in edits.items() if any(word in name for word in chosen.edits)}
    if chosen.quick:
        edits = dict(list(edits.items())[::5])
    magic = "installed" if magick_program() else "not installed, so that its edits are left out"
    print(f"{len(edits)} edits; ImageMagick is {magic}")
    half = len(used) // 2
    print(f"fitted: {', '.join(used[:half])}; held out: {', '.join(used[half:])}")
    photographs = [(images[name] * 255).round() / 255 for name in used]
    pairs = {name: [(image, applied(edit, image)) for image in photographs] for name, edit in edits.items()}
    for count in [1, 2] if chosen.quick else chosen.counts:
        if count > half:
            print(f"\n{count} pairs are left out: of {len(used)} photographs, {half} are fitted")
            continue
        report(pairs, {name: METHODS[name] for name in ("look", *chosen.methods)}, count)


def report(
    pairs: dict[str, list[tuple[Tensor, Tensor]]], methods: dict[str, Callable[[Pairs], Predict]], count: int
) -> None:
    """A table for a number of pairs that are fitted at once."""
    print(f"\nafter {count} pair{'s' * (count > 1)}: fitted mean, held out mean (lowest), in percent")
    print(row("", methods, 21, 34))
    best, tied, judged = 0, 0, 0
    for edit, examples in pairs.items():
        half = len(examples) // 2
        fitted, held = examples[: half if count == 1 else count], examples[half:]
        if not all(any(is_changed(*pair) for pair in part) for part in (fitted, held)):
            print(f"{edit:34}  left out, since it changes none of the fitted or of the held-out photographs")
            continue
        judged, cells, means = judged + 1, [], {}
        for method, fit in methods.items():
            of_fitted, of_held = judge(fit, fitted, held, at_once=count > 1)
            means[method] = statistics.mean(of_held)
            cells.append(f"{statistics.mean(of_fitted):6.1f} {means[method]:6.1f} ({min(of_held):4.0f})")
        others = [value for name, value in means.items() if name != "look"]
        own, other = (round(value, 1) for value in (means["look"], max(others, default=-float("inf"))))
        best, tied = best + (own > other), tied + (own == other)
        verdict = "" if own > other else "  tied" if own == other else "  lost"
        print(row(edit, cells, 21, 34) + verdict, flush=True)
    if len(methods) > 1:
        print(f"best of all on {best} of {judged}, held out, and tied on {tied}")


if __name__ == "__main__":
    main()
