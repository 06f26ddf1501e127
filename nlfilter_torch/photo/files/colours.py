"""Colours that a file describes by numbers in place of a profile. The output does not describe them."""

from collections.abc import Sequence
from pathlib import Path

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.files.decoded import UnhandledImage

# Numbers of ITU-T H.273 (CICP).
PRIMARIES = {1: "sRGB", 4: "BT.470", 5: "BT.601", 6: "BT.601", 7: "SMPTE 240M", 9: "BT.2020", 11: "DCI-P3"}
PRIMARIES |= {12: "Display P3"}
TRANSFERS = {5: "a gamma of 2.8", 8: "linear light", 16: "PQ", 17: "SMPTE 428", 18: "HLG"}
USUAL_PRIMARIES = (0, 1, 2)  # reserved, of sRGB, and unspecified
USUAL_TRANSFERS = (0, 1, 2, 4, 6, 13, 14, 15)  # likewise, and curves close to that of sRGB, which viewers treat alike
HDR = (16, 18)

# Of PNG files.
SRGB = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)  # x and y of white, red, green and blue
NEAR = 0.01
GAMMA = 1 / 2.2
NEAR_GAMMA = 0.05  # share


def check_numbers(path: Path, primaries: int, transfer: int) -> None:
    """Warn if colours described by these numbers are not close to sRGB.

    Raises:
        UnhandledImage: if they are those of an HDR picture.
    """
    if transfer in HDR:
        raise UnhandledImage(
            f"{path} is an HDR picture ({TRANSFERS[transfer]}), which is not supported; convert it to sRGB, or to a "
            "TIFF file with a colour profile"
        )
    unusual = [] if primaries in USUAL_PRIMARIES else [PRIMARIES.get(primaries, f"primaries number {primaries}")]
    if transfer not in USUAL_TRANSFERS:
        unusual.append(TRANSFERS.get(transfer, f"transfer function number {transfer}"))
    _warn(path, unusual)


def check_png(path: Path, gamma: float | None, chromaticities: Sequence[float] | None) -> None:
    """Warn if the chunks gAMA and cHRM of a PNG file describe other colours than sRGB; None if a chunk is missing."""
    unusual = []
    if chromaticities is not None and max(abs(a - b) for a, b in zip(chromaticities, SRGB, strict=True)) > NEAR:
        unusual.append("other primaries than sRGB")
    if gamma is not None and gamma > 0 and abs(gamma / GAMMA - 1) > NEAR_GAMMA:
        unusual.append(f"a gamma of {1 / gamma:.2g}")
    _warn(path, unusual)


def _warn(path: Path, unusual: Sequence[str]) -> None:
    if unusual:
        warn(
            f"{path} has {' and '.join(unusual)} without a colour profile, which the output will not say, so that its "
            "colours will look different; convert the photograph to sRGB, or embed a profile, before the edit"
        )
