"""The named looks: steps of ``look`` with tone curves and colours only, chosen by eye. The editor shows them."""

from nlfilter_torch.photo.declared.steps import Step

_GREY = (0.32, 0.52, 0.16)  # red, green and blue in a grey photograph; more red than luminance has keeps skin light
_SOFT_CONTRAST = (0.0, 0.215, 0.5, 0.785, 1.0)


def _look(red: tuple[float, ...], green: tuple[float, ...], blue: tuple[float, ...], saturation: float = 1.0) -> Step:
    """A look of three curves and a factor of saturation."""
    return Step("look", red=red, green=green, blue=blue, saturation=(saturation,) * 5)


#: The looks, which are presets too.
LOOKS: dict[str, Step] = {
    "vivid": _look(_SOFT_CONTRAST, _SOFT_CONTRAST, _SOFT_CONTRAST, 1.2),
    "warm": _look((0.0, 0.27, 0.54, 0.78, 1.0), (0.0, 0.25, 0.505, 0.755, 1.0), (0.0, 0.23, 0.46, 0.7, 0.96), 1.05),
    "cool": _look((0.0, 0.23, 0.465, 0.715, 0.97), (0.0, 0.245, 0.5, 0.75, 1.0), (0.015, 0.275, 0.54, 0.785, 1.0)),
    "faded": _look((0.08, 0.29, 0.51, 0.73, 0.95), (0.07, 0.28, 0.5, 0.72, 0.94), (0.09, 0.29, 0.5, 0.7, 0.9), 0.75),
    "mono": Step("look", matrix=_GREY * 3),  # curves, which act on each channel, would tint it
}

#: Short descriptions of the :data:`LOOKS`.
CHARACTERS: dict[str, str] = {
    "vivid": "more contrast and colour",
    "warm": "lighter, towards red and yellow",
    "cool": "slightly darker, towards blue",
    "faded": "lifted shadows, dimmed highlights, pale colours",
    "mono": "black and white, with light skin",
}
