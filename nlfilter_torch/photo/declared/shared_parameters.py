"""Parameters shared by several edits, functions that declare common kinds of parameters, and the look."""

from typing import TypedDict, Unpack

from nlfilter_torch.photo.declared.declaration import (
    FILTER_PANEL,
    GAINS,
    MAX_LANDMARKS,
    MAX_PATCH,
    PHOTOMETRIC_RANGE,
    SPATIAL_RANGE,
    USUAL_GAINS,
    Domain,
    Edit,
    Parameter,
    Slider,
    Unit,
)
from nlfilter_torch.photo.declared.json_values import Value


class Presentation(TypedDict, total=False):
    """Attributes of :class:`Parameter` for gains, all with a default."""

    optional: bool
    idle: Value
    slider: Slider
    panel: str
    usual: tuple[float, float]


class Further(Presentation, total=False):
    """Attributes of :class:`Parameter` for numbers and lists of numbers, all with a default."""

    domain: Domain
    words: tuple[str, ...]
    zero_meaning: str
    argument: str
    share: float
    min_pixels: float
    metavar: str
    is_option: bool
    is_argument: bool
    length: int
    per_image: bool
    part: bool


ALIKE = "How much two places may differ and still count as similar"
#: Arguments of the filter of an edit.
FILTER_ARGUMENTS = ("photometric_bandwidth", "spatial_bandwidth", "patch_size", "num_landmarks", "landmarks")


def number(
    name: str, default: Value, help: str, ends: tuple[float, float], unit: Unit = "", **further: Unpack[Further]
) -> Parameter:
    """Declare a number within a range."""
    return Parameter(name, "number", default, help, *ends, unit, **further)


def gain(name: str, default: float | None, help: str, **further: Unpack[Presentation]) -> Parameter:
    """Declare a factor."""
    return number(name, default, help, GAINS, "gain", domain="finite", per_image=True, **further)


def sliders(
    name: str, default: tuple[float, ...] | None, help: str, unit: Unit = "gain", **further: Unpack[Further]
) -> Parameter:
    """Declare a list of numbers."""
    return Parameter(name, "sliders", default, help, *GAINS, unit, **further)


def choice(name: str, choices: tuple[str, ...], help: str) -> Parameter:
    """Declare a choice among words, the first by default."""
    return Parameter(name, "choice", choices[0], help, domain="choice", choices=choices)


def part(name: str, help: str, label: str) -> Parameter:
    """Declare the share of a part of what an edit changes, all of it by default, with a slider."""
    slider = Slider(label, 0, 1, 0.05)
    return number(name, 1.0, help, (0, 1), domain="share", metavar="0...1", slider=slider, per_image=True, part=True)


def filter_parameters(
    *,
    bandwidth: float | str | None = None,
    share: float = 0.0,
    patch_size: int = 5,
    landmarks: int = 100,
    auto: bool = False,
    far: bool = False,
) -> tuple[Parameter, ...]:
    """Declare the filter parameters of an edit, with its defaults; ``far`` allows ``"none"`` as spatial bandwidth."""
    levels = f"{ALIKE}, in grey levels from 0 to 255. Small values (5) affect fine texture only, large ones (40) treat "
    photometric = number(
        "bandwidth",
        bandwidth,
        levels + ("much as detail. `auto` estimates it from the picture." if auto else "wide areas as one."),
        PHOTOMETRIC_RANGE,
        "levels",
        words=("auto",) if auto else (),
        optional=bandwidth is None,
        argument="photometric_bandwidth",
        panel=FILTER_PANEL,
    )
    reach = "no limit" if share == 0 else f"{share:.2g} of the short side"
    if far:
        reach += ". `none`: distance is ignored, and large areas of light and dark count as detail too"
    return (
        photometric,
        number(
            "spatial_bandwidth",
            None,
            f"How far apart two places may be and still count as similar. Default: {reach}.",
            SPATIAL_RANGE,
            "px",
            words=("none",) if far else (),
            optional=True,
            share=share,
            panel=FILTER_PANEL,
        ),
        Parameter(
            "patch_size",
            "odd",
            patch_size,
            "Width of the compared patch around each pixel, an odd number. 1 compares single pixels.",
            1,
            MAX_PATCH,
            "px",
            panel=FILTER_PANEL,
        ),
        Parameter(
            "landmarks",
            "count",
            landmarks,
            "Number of typical patches that represent the whole picture. More are more accurate, but slower, and need "
            "more memory.",
            1,
            MAX_LANDMARKS,
            argument="num_landmarks",
            metavar="N",
            panel=FILTER_PANEL,
        ),
        Parameter(
            "sampling",
            "choice",
            "kmeans",
            "How the typical patches are chosen: by grouping similar ones, on a regular grid, or at random.",
            choices=("kmeans", "uniform", "random"),
            argument="landmarks",
            panel=FILTER_PANEL,
        ),
    )


# Options of a filter whose detail layers exclude shading, for edits of brightness.
SHADING_LEVELS = 20.0  # photometric bandwidth, in grey levels
SHADING_DISTANCE = 1 / 12  # spatial bandwidth, as a fraction of the short side; excludes shading from the detail layers
SHADING_LANDMARKS = 300
#: Filter parameters of the edits of brightness that separate shading from detail.
WITHOUT_SHADING = filter_parameters(
    bandwidth=SHADING_LEVELS, share=SHADING_DISTANCE, landmarks=SHADING_LANDMARKS, auto=True, far=True
)
#: For all edits of brightness.
LIMITS = choice(
    "limits",
    ("soft", "none"),
    "Limits of brightening and darkening: `soft` keeps detail in highlights and shadows, `none` lets them clip.",
)
#: For all edits of brightness.
VIEWING_SIZE = number(
    "viewing_size",
    1.5,
    "Size at which the picture is viewed, in megapixels, so that the sliders have the same effect at any resolution. "
    "In larger photographs, patches and lengths are measured in pixels at that size. 0: the size of the file.",
    (0, 1e6),
    domain="not negative",
    zero_meaning="pass 0 for the size of the image",
    metavar="MEGAPIXELS",
    panel=FILTER_PANEL,
)
#: For all edits that select objects.
COLOUR_TOLERANCE = number(
    "tolerance",
    8.0,
    "How much two colours may differ and still count as similar, in units of CIE Lab.",
    (1, 100),
    "lab",
    argument="photometric_bandwidth",
    panel=FILTER_PANEL,
)
#: For all edits that select regions.
REGION_REACH = number(
    "reach",
    0.65,
    "How far a region spreads to less similar areas. 0 stays close, 0.95 goes far.",
    (0, 0.999),
    domain="below 1",
    metavar="0...1",
    panel=FILTER_PANEL,
    per_image=True,
)
#: For all edits that select regions.
EXTENT = Parameter(
    "extent",
    "choice",
    "near",
    "Which similar areas belong to the region: `near`, those nearby; `object`, only what is connected with a scribble; "
    "`everywhere`, all of the picture.",
    domain="choice",
    choices=("near", "object", "everywhere"),
    labels=("All alike", "Only this", "Far away, too"),
)
REGION_REACH_SLIDER = Slider("Reach of the region", 0, 0.95, 0.05)


CURVE_KNOTS = 17  # of a tone curve
SATURATIONS = 5  # that have a factor of their own
STRAIGHT = tuple(i / (CURVE_KNOTS - 1) for i in range(CURVE_KNOTS))


def _curve(channel: str) -> Parameter:
    help = f"Tone curve of {channel}: its output at equal steps of the input from black to white, separated by commas."
    return sliders(channel, STRAIGHT, help, unit="", idle=STRAIGHT, metavar="V,V,...,V")


LOOK = Edit(
    "look",
    """Apply a look to a photograph: tone curves, colours, contrast and details, like those of another edit.

    `nlfilter-torch fit` finds looks from photographs before and after an edit, and `nlfilter-torch apply` takes them.

    Sepia: `nlfilter-torch look in.jpg out.jpg --matrix .39,.77,.19,.35,.69,.17,.27,.53,.13`
    """,
    (
        sliders(
            "alpha",
            (1.0, 1.0, 1.0, 1.0),
            "One slider for each layer of detail, like those of `nlfilter-torch detail`. 1 leaves a layer as it is.",
            idle=1.0,
            usual=USUAL_GAINS,
            metavar="A,B,...,Z",
        ),
        sliders(
            "bands",
            (1.0,) * 7,
            "Strength of structures finer than 1, 2, 5, 9, 18 and 37 pixels, including edges, and of larger ones, "
            "around the mean brightness. 1 leaves them as they are.",
            idle=(1.0,) * 7,
            metavar="A,B,...,G",
            length=7,
        ),
        sliders(
            "texture",
            (1.0,) * 6,
            "Strength of structures finer than 1, 2, 5, 9, 18 and 37 pixels on surfaces, where brightness varies "
            "little, but not at edges. 1 leaves them as they are.",
            idle=(1.0,) * 6,
            metavar="A,B,...,F",
            length=6,
        ),
        _curve("red"),
        _curve("green"),
        _curve("blue"),
        sliders(
            "matrix",
            (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            "Colour matrix, row by row: how much of the old red, green and blue makes up the new red, green and blue.",
            unit="",
            idle=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            metavar="RR,RG,...,BB",
            length=9,
        ),
        sliders(
            "saturation",
            (1.0,) * SATURATIONS,
            "Factors of saturation as in HSV, which multiply the distances of red, green and blue from the largest of "
            "them: one factor for each of five equal steps from grey to pure colours. 1 leaves colours as they are.",
            idle=(1.0,) * SATURATIONS,
            metavar="A,B,...,E",
        ),
        sliders(
            "stretch",
            (0.0,) * 3,
            "Automatic levels, which turn the darkest pixel black and the lightest one white: strengths of the change "
            "of luminance, of that of the largest channel with the others in proportion, and of that of each channel "
            "by itself. 0 is none.",
            unit="",
            idle=(0.0,) * 3,
            metavar="A,B,C",
            length=3,
        ),
        sliders(
            "local",
            (0.0,) * 8,
            "Local contrast by equalising the histogram around every pixel, with contrast limited to 1.5, 2, 3 and 5 "
            "times: four strengths for luminance, then four for all channels in proportion. 0 is none.",
            unit="",
            idle=(0.0,) * 8,
            metavar="A,B,...,H",
            length=8,
        ),
        Parameter(
            "lattice",
            "lattice",
            None,
            "Changes of red, then of green, then of blue at the nodes of a grid of colours: n equal steps of red from "
            "0 to 1, each with n of green, each with n of blue. In between they are interpolated. Default: none.",
            *GAINS,
            optional=True,
            idle=None,
            is_option=False,  # too long; files hold it
        ),
        gain(
            "amount",
            1.0,
            "How much of the look: 0 none, 1 all of it, 2 twice as much.",
            slider=Slider("Amount", 0, 2, 0.05),
        ),
        VIEWING_SIZE,
        *WITHOUT_SHADING,
    ),
    function="apply_look",
    hint="Choose a look, or load one by Load edit: from nlfilter-torch fit, a .cube file or a Hald picture.",
)
