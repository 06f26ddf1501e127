"""Figures of other denoisers as their papers give them: white noise of known level, PSNR in dB."""

from dataclasses import dataclass

#: Papers, by the words with which a table names them.
SOURCES = {
    "Zhang 2017": "K. Zhang et al., Beyond a Gaussian Denoiser, IEEE Trans. Image Processing 26(7), 2017: BSD68 "
    "(Table II) and Set12 (Table III), with one network for each level",
    "Zhang 2018": "K. Zhang et al., FFDNet, IEEE Trans. Image Processing 27(9), 2018: the tables of grey sets (Set12, "
    "BSD68) and colour sets (CBSD68, Kodak24, McMaster)",
    "Liu 2018": "D. Liu et al., Non-Local Recurrent Network for Image Restoration, NeurIPS 2018: the table of Set12, "
    "BSD68 and Urban100",
    "Lecouat 2020": "B. Lecouat et al., Fully Trainable and Interpretable Non-Local Sparse Models for Image "
    "Restoration, ECCV 2020: the tables of grey and of colour denoising, with one network for each level",
    "Zhang 2021": "K. Zhang et al., Plug-and-Play Image Restoration with Deep Denoiser Prior, IEEE Trans. Pattern "
    "Analysis and Machine Intelligence, 2021 (arXiv 2008.13751): the tables of grey (Set12, BSD68, Urban100) and "
    "colour denoising (CBSD68, Kodak24, McMaster)",
}


@dataclass(frozen=True)
class Published:
    """PSNR of a method at 15, 25 and 50 grey levels, where it is known.

    Attributes:
        method: its name.
        weights: number of its trained weights in thousands; None if it has none, or the number is uncertain.
        psnr: means over the set in dB, in the order of :data:`benchmarks.denoising.sets.LEVELS`.
        source: key of :data:`SOURCES`.
    """

    method: str
    weights: int | None
    psnr: tuple[float | None, float | None, float | None]
    source: str


# CBM3D on Kodak24 at 25 is left out: papers disagree by half a decibel.
#: By set and kind of picture.
PUBLISHED: dict[tuple[str, str], tuple[Published, ...]] = {
    ("BSD68", "grey"): (
        Published("BM3D", None, (31.08, 28.57, 25.60), "Zhang 2021"),
        Published("DnCNN", 556, (31.73, 29.23, 26.23), "Zhang 2017"),
        Published("FFDNet", 485, (31.63, 29.19, 26.29), "Zhang 2018"),
        Published("GroupSC", 68, (31.70, 29.19, 26.18), "Lecouat 2020"),
        Published("NLRN", None, (31.88, 29.41, 26.47), "Liu 2018"),
        Published("DRUNet", 32_640, (31.91, 29.48, 26.59), "Zhang 2021"),
    ),
    ("Set12", "grey"): (
        Published("BM3D", None, (32.37, 29.97, 26.72), "Zhang 2021"),
        Published("DnCNN", 556, (32.86, 30.44, 27.18), "Zhang 2017"),
        Published("FFDNet", 485, (32.75, 30.43, 27.32), "Zhang 2018"),
        Published("NLRN", None, (33.16, 30.80, 27.64), "Liu 2018"),
        Published("DRUNet", 32_640, (33.25, 30.94, 27.90), "Zhang 2021"),
    ),
    ("Urban100", "grey"): (
        Published("BM3D", None, (32.35, 29.70, 25.95), "Zhang 2021"),
        Published("DnCNN", 556, (32.64, 29.95, 26.26), "Zhang 2021"),
        Published("FFDNet", 485, (32.40, 29.90, 26.50), "Zhang 2021"),
        Published("NLRN", None, (33.45, 30.94, 27.49), "Liu 2018"),
        Published("DRUNet", 32_640, (33.44, 31.11, 27.96), "Zhang 2021"),
    ),
    ("CBSD68", "colour"): (
        Published("CBM3D", None, (33.52, 30.71, 27.38), "Zhang 2018"),
        Published("FFDNet", 850, (33.87, 31.21, 27.96), "Zhang 2018"),
        Published("GroupSC", 119, (34.12, 31.41, 28.08), "Lecouat 2020"),
        Published("DRUNet", 32_640, (34.30, 31.69, 28.51), "Zhang 2021"),
    ),
    ("Kodak24", "colour"): (
        Published("CBM3D", None, (34.28, None, 28.46), "Zhang 2018"),
        Published("FFDNet", 850, (34.63, 32.13, 28.98), "Zhang 2018"),
        Published("DRUNet", 32_640, (35.31, 32.89, 29.86), "Zhang 2021"),
    ),
    ("McMaster", "colour"): (
        Published("CBM3D", None, (34.06, 31.66, 28.51), "Zhang 2018"),
        Published("FFDNet", 850, (34.66, 32.35, 29.18), "Zhang 2018"),
        Published("DRUNet", 32_640, (35.40, 33.14, 30.08), "Zhang 2021"),
    ),
}


def published(name: str, kind: str) -> tuple[Published, ...]:
    """Figures for a set in ``"grey"`` or ``"colour"``; none where the literature has none."""
    return PUBLISHED.get((name, kind), ())
