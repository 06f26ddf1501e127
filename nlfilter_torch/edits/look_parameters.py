"""The look and its parameters, see :mod:`nlfilter_torch.edits.parameters`."""

from nlfilter_torch.edits.declaration import Edit, Parameter, Slider
from nlfilter_torch.edits.shared_parameters import VIEWING_SIZE, WITHOUT_SHADING, gain, sliders

KNOTS = 17  # of a tone curve
SATURATIONS = 5  # that have a factor of their own
STRAIGHT = tuple(i / (KNOTS - 1) for i in range(KNOTS))


def _curve(channel: str) -> Parameter:
    help = f"Tone curve of {channel}: what it becomes at equal steps from black to white, with commas between."
    return sliders(channel, STRAIGHT, help, unit="", idle=STRAIGHT, metavar="V,V,...,V")


LOOK = Edit(
    "look",
    """Put a photograph under a look: tone curves, colours, contrast and details, as another edit had them.

    `nlfilter-torch fit` finds looks from photographs before and after an edit, and `nlfilter-torch apply` takes them.

    Sepia: `nlfilter-torch look in.jpg out.jpg --matrix .39,.77,.19,.35,.69,.17,.27,.53,.13`
    """,
    (
        sliders(
            "alpha",
            (1.0, 1.0, 1.0, 1.0),
            "One slider for each layer of detail, as those of `nlfilter-torch detail`. 1 leaves a layer as it is.",
            idle=1.0,
            metavar="A,B,...,Z",
        ),
        sliders(
            "bands",
            (1.0,) * 7,
            "Strength of what is finer than 1, 2, 5, 9, 18 and 37 pixels, edges too, and of the rest, around the mean "
            "brightness. 1 leaves it as it is.",
            idle=(1.0,) * 7,
            metavar="A,B,...,G",
            length=7,
        ),
        sliders(
            "texture",
            (1.0,) * 6,
            "Strength of what is finer than 1, 2, 5, 9, 18 and 37 pixels where brightness varies little: surfaces, not "
            "edges. 1 leaves it as it is.",
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
            "Three rows of three numbers: how much red, green and blue of the photograph goes into each.",
            unit="",
            idle=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            metavar="RR,RG,...,BB",
            length=9,
        ),
        sliders(
            "saturation",
            (1.0,) * SATURATIONS,
            "How many times as far red, green and blue are to be from the largest of them, as saturation in HSV: a "
            "factor for each of five equal steps from grey to pure colours. 1 leaves them as they are.",
            idle=(1.0,) * SATURATIONS,
            metavar="A,B,...,E",
        ),
        sliders(
            "stretch",
            (0.0,) * 3,
            "Automatic levels: how much of the change that stretches brightness from the darkest to the lightest pixel "
            "to black and white is added: of luminance, of the largest channel with colours in proportion, and of each "
            "channel for itself. 0 is none.",
            unit="",
            idle=(0.0,) * 3,
            metavar="A,B,C",
            length=3,
        ),
        sliders(
            "local",
            (0.0,) * 8,
            "Local contrast: how much of the change that equalises the histogram around each pixel is added, under "
            "limits of contrast of 1.5, 2, 3 and 5: four numbers for luminance, four for colours in proportion. 0 is "
            "none.",
            unit="",
            idle=(0.0,) * 8,
            metavar="A,B,...,H",
            length=8,
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
    hint="A look that was found by `nlfilter-torch fit`; load its file, and choose how much of it.",
)
