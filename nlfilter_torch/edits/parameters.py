"""The edits and their parameters: everything that functions, commands, files, the editor and the documentation share.

``docs/parameters.md`` is made from it (``python -m benchmarks.parameters docs/parameters.md``).
"""

from dataclasses import replace
from typing import Any

from nlfilter_torch.edits.declaration import (
    BANDWIDTHS,
    DISTANCES,
    GAINS,
    MAX_LANDMARKS,
    MAX_PATCH,
    Edit,
    Parameter,
    Slider,
)

ALIKE = "How different two spots may be and still count as alike"
CRISP = (2.2, 2.2, 2.2, 1.0)
NEAR = 1 / 12  # of the short side: how far shading is compared, so that it is no detail
#: Arguments of the filter of an edit.
FILTER = ("photometric_bandwidth", "spatial_bandwidth", "patch_size", "num_landmarks", "landmarks")


def _filter(
    *,
    bandwidth: Any = None,
    share: float = 0.0,
    patch_size: int = 5,
    landmarks: int = 100,
    auto: bool = False,
    far: bool = False,
) -> tuple[Parameter, ...]:
    """Parameters of the filter of an edit, with its defaults; ``far`` if distance may also not count at all."""
    levels = f"{ALIKE}, in grey levels from 0 to 255. Small values (5) touch fine texture only, large ones (40) treat "
    photometric = Parameter(
        "bandwidth",
        "number",
        bandwidth,
        levels + ("much as detail. `auto` looks at the picture." if auto else "much as one."),
        *BANDWIDTHS,
        "levels",
        words=("auto",) if auto else (),
        optional=bandwidth is None,
        argument="photometric_bandwidth",
    )
    reach = "as far as the picture goes" if share == 0 else f"{share:.2g} of the short side"
    if far:
        reach += ". `none`: distance does not count, and large areas of light and dark are details, too"
    return (
        photometric,
        Parameter(
            "spatial_bandwidth",
            "number",
            None,
            f"How far apart two spots may be and still count as alike. Left out: {reach}.",
            *DISTANCES,
            "px",
            words=("none",) if far else (),
            optional=True,
            share=share,
        ),
        Parameter(
            "patch_size",
            "odd",
            patch_size,
            "Width of the patch around each spot that is compared; an odd number. 1 compares single pixels.",
            1,
            MAX_PATCH,
            "px",
        ),
        Parameter(
            "landmarks",
            "count",
            landmarks,
            "Number of typical patches that stand for the whole picture. More are truer, slower and take more memory.",
            1,
            MAX_LANDMARKS,
            argument="num_landmarks",
            metavar="N",
        ),
        Parameter(
            "sampling",
            "choice",
            "kmeans",
            "How the typical patches are found: by grouping similar ones, on a regular grid, or at random.",
            choices=("kmeans", "uniform", "random"),
            argument="landmarks",
        ),
    )


#: Of all edits of brightness.
LIMITS = Parameter(
    "limits",
    "choice",
    "soft",
    "How far pixels may get brighter or darker: `soft` keeps what highlights and shadows show, `none` lets them clip.",
    domain="choice",
    choices=("soft", "none"),
)
#: Likewise.
VIEWING_SIZE = Parameter(
    "viewing_size",
    "number",
    1.5,
    "Size at which the picture is looked at, in millions of pixels, so that the sliders do the same to it at any "
    "resolution. In larger photographs patches and lengths are counted in pixels of that size. 0: of the file.",
    0,
    1e6,
    domain="not negative",
    zero="0 is the size of the image",
    metavar="MEGAPIXELS",
)
#: Of all edits that find a thing.
TOLERANCE = Parameter(
    "tolerance",
    "number",
    8.0,
    "How different two colours may be and still count as alike, in units of CIE Lab.",
    1,
    100,
    "lab",
    argument="photometric_bandwidth",
)
#: Of all edits that find regions.
REACH = Parameter(
    "reach",
    "number",
    0.6,
    "How far a region spreads from what is alike to what is less so. 0 stays close, 0.95 goes far.",
    0,
    0.999,
    domain="below 1",
    metavar="0...1",
)
REACH_SLIDER = Slider("Reach of the region", 0, 0.95, 0.05)


def reach_of_time(time: float) -> float:
    """The reach of a region for the diffusion time that files had in its place: 0.6 for 1, the default of both."""
    return time / (time + 2 / 3) if time > 0 else time


DETAIL = Edit(
    "detail",
    """Make the details of a photograph stronger or weaker, each size of them by a slider of its own.

    Colours stay as they are where nothing clips, and so do the file's depth, transparency, colour profile and notes of
    the camera (EXIF). Photographs that fit no memory are worked out in tiles; best as TIFF files or arrays of zarr,
    read in parts.

    Sharpen strongly: `nlfilter-torch detail in.jpg out.jpg --alpha 3,3,3,1`

    A look with a name: `nlfilter-torch detail in.jpg out.jpg --preset crisp`

    Smooth skin or noise away: `nlfilter-torch detail in.jpg out.jpg --alpha 0.2,0.5,1,1 --bandwidth 10`

    Sharpen all that looks like a spot: `nlfilter-torch detail in.jpg out.jpg --region 60,300,20,20`

    By the name of a look: `nlfilter-torch detail in.jpg out.jpg --preset "soft skin"` (see `nlfilter-torch presets`)

    Edit like another photograph: `nlfilter-torch detail in.jpg out.jpg --preset look.json` (see `nlfilter-torch fit`)
    """,
    (
        Parameter(
            "alpha",
            "sliders",
            CRISP,
            "One slider for each layer, from the finest detail to the smooth shading, with commas between. 1 leaves a "
            "layer as it is, 3 makes it three times as strong, 0 takes it away.",
            *GAINS,
            "gain",
            idle=1.0,
            metavar="A,B,...,Z",
        ),
        Parameter(
            "inside",
            "sliders",
            None,
            "The sliders inside what looks like the strokes; as many. Left out: 1 for each.",
            *GAINS,
            "gain",
            optional=True,
            is_option=False,  # --region has them
        ),
        Parameter(
            "residual",
            "number",
            None,
            "Strength of the grain that no typical patch explains. 1 leaves it as it is, which keeps noise down. "
            "Left out: as the first slider of --alpha.",
            *GAINS,
            "gain",
            domain="finite",
            optional=True,
            idle=None,
        ),
        Parameter(
            "channels",
            "choice",
            "luminance",
            "Edit brightness and keep the colours, or edit red, green and blue alike, colours too.",
            domain="choice",
            choices=("luminance", "all"),
        ),
        replace(REACH, former=(("time", reach_of_time), ("spread", reach_of_time)), slider=REACH_SLIDER),
        replace(TOLERANCE, argument="mask_bandwidth"),
        Parameter(
            "threshold",
            "number",
            5.0,
            "Detail of less contrast than this is strengthened less, since it may be noise: a standard deviation in "
            "grey levels of 255. 0: all alike.",
            0,
            255,
            "levels",
            domain="not negative",
            zero="0 strengthens all detail alike",
        ),
        LIMITS,
        VIEWING_SIZE,
        *_filter(bandwidth=20.0, share=NEAR, landmarks=300, auto=True, far=True),
    ),
    hint="Paint on what is to have sliders of its own; all that looks like it follows.",
    brushes=(("in", "Edit this"), ("out", "Not this")),
)

SHARPEN = Edit(
    "sharpen",
    """Sharpen a photograph and leave its noise alone: one slider instead of those of `nlfilter-torch detail`.

    Example: `nlfilter-torch sharpen in.jpg out.jpg --amount 5`
    """,
    (
        Parameter(
            "amount",
            "number",
            4.0,
            "Strength: 1 leaves the photograph as it is, 4 is visible, 8 is strong.",
            *GAINS,
            "gain",
            domain="finite",
            idle=1.0,
            slider=Slider("Amount", 0, 10, 0.5, live=False),
        ),
        Parameter(
            "guide_blur",
            "number",
            1.2,
            "How much noise and the finest grain are overlooked: 0 not at all.",
            0,
            1e4,
            "px",
            domain="not negative",
            zero="0 leaves the guide as it is",
            slider=Slider("Grain overlooked", 0, 4, 0.1, live=False),
        ),
        LIMITS,
        VIEWING_SIZE,
        *_filter(bandwidth=10.0, auto=True),
    ),
    hint="Sharper edges without more noise.",
)

TONE = Edit(
    "tone",
    """Raise or lower contrast without a change of colour or of mean brightness, but where the picture clips.

    Example: `nlfilter-torch tone in.jpg out.jpg --contrast 1.2 --clarity 2`
    """,
    (
        Parameter(
            "contrast",
            "number",
            1.2,
            "Contrast of the smooth shading: 1 leaves it, 1.4 is strong, 0.7 flattens.",
            *GAINS,
            "gain",
            domain="finite",
            idle=1.0,
            slider=Slider("Contrast", 0.5, 1.5, 0.05, live=False),
        ),
        Parameter(
            "clarity",
            "number",
            1.0,
            "Contrast of the largest details on it: 1 leaves it, 4 is strong.",
            *GAINS,
            "gain",
            domain="finite",
            idle=1.0,
            slider=Slider("Clarity", 0, 5, 0.1, live=False),
        ),
        LIMITS,
        VIEWING_SIZE,
        *_filter(bandwidth=20.0, share=NEAR, landmarks=300, auto=True, far=True),
    ),
    hint="Contrast of large shapes, and of the detail on them.",
)

DENOISE = Edit(
    "denoise",
    """Remove noise from a photograph.

    The noise is measured in the photograph, and whether it grows with the light.

    Example: `nlfilter-torch denoise in.jpg out.jpg`

    Gently: `nlfilter-torch denoise in.jpg out.jpg --strength 0.6`
    """,
    (
        Parameter(
            "strength",
            "number",
            1.0,
            "How much is taken away: 1 removes the noise that was found or given, less leaves some, more smooths.",
            0,
            4,
            domain="not negative",
            zero="0 changes nothing",
            idle=0.0,
            slider=Slider("Strength", 0, 2, 0.05, live=False),
        ),
        Parameter(
            "noise_level",
            "number",
            None,
            "The noise: its standard deviation in grey levels of 255. Left out: measured.",
            0,
            255,
            "levels",
            domain="not negative",
            zero="0 changes nothing",
            optional=True,
        ),
        Parameter(
            "method",
            "choice",
            "network",
            "`network`: trained on photographs. `rule`: by sliders of the filter, which the options below are for.",
            domain="choice",
            choices=("network", "rule"),
        ),
        *_filter(share=0.2, landmarks=200),
    ),
    hint="Less noise: it is measured, and taken away as strongly as you choose.",
)

RECOLOR = Edit(
    "recolor",
    """Give a thing another colour: paint a little of it on it, and the rest of it takes it, and its likes nearby.

    Brightness stays as it is to the last bit, and so does whatever is beyond the borders of the thing. Photographs that
    fit no memory are worked out in tiles; best as TIFF files or arrays of zarr, read in parts.

    A red car blue: `nlfilter-torch recolor in.jpg out.jpg --region 420,215,14,14:blue`

    Spare the wood: `nlfilter-torch recolor in.jpg out.jpg --strokes paint.png --keep 60,100,20,20`
    """,
    (
        Parameter(
            "reach",
            "number",
            0.6,
            "How far the colour spreads from what is alike to what is less so. 0 stays close, 0.95 goes far.",
            0,
            0.999,
            domain="below 1",
            metavar="0...1",
            slider=Slider("Reach", 0, 0.95, 0.05),
        ),
        replace(TOLERANCE, former=(("bandwidth", 1.0),), slider=Slider("Tolerance", 3, 40, 1, live=False)),
        *_filter(share=1.2, patch_size=1)[1:],
    ),
    hint="Choose a colour and paint a little of it on a thing; its likes take it.",
    brushes=(("colour", "Paint"), ("keep", "Keep as it is")),
    needs=True,
)

COLORIZE = Edit(
    "colorize",
    """Colour a grey photograph: paint some strokes, and the colours spread over what looks alike nearby.

    Brightness stays as it is. A photograph in colour is taken for a grey one: its own colours are replaced. Photographs
    that fit no memory are worked out in tiles, by regression; best as TIFF files or arrays of zarr, read in parts.

    Example: `nlfilter-torch colorize grey.jpg out.jpg --strokes paint.png`

    Without painting: `nlfilter-torch colorize grey.jpg out.jpg --region 10,10,30,30:skyblue --region 10,300,9,9:green`
    """,
    (
        Parameter(
            "strength",
            "number",
            1.0,
            "How much colour goes to what resembles no stroke: 1 colours everything, 0 leaves it grey.",
            0,
            1,
            domain="share",
            metavar="0...1",
            slider=Slider("Fill", 0, 1, 0.05),
        ),
        Parameter(
            "method",
            "choice",
            "regression",
            "Soft colours that mix between strokes, or one flat colour for each of as many pieces (k-means).",
            domain="choice",
            choices=("regression", "kmeans"),
        ),
        *_filter(bandwidth=40.0, share=0.5625)[:4],
    ),
    hint="For grey photographs: paint some colours, and they spread over what looks alike nearby.",
    brushes=(("colour", "Paint"),),
    needs=True,
    coloured=True,
)

DEFOCUS = Edit(
    "defocus",
    """Blur a photograph as a wide aperture would, but for the thing that you mark.

    Mark a spot of it, or of each of its parts; the rest of it is found.

    Example: `nlfilter-torch defocus in.jpg out.jpg --region 190,60,60,60 --region 60,260,40,180`
    """,
    (
        Parameter(
            "radius",
            "number",
            2.5,
            "Radius of the strongest blur, in hundredths of the short side.",
            0.1,
            20,
            "%",
            domain="positive",
            slider=Slider("Blur", 0.5, 10, 0.1),
        ),
        Parameter(
            "aperture",
            "choice",
            "disc",
            "Turn dots into discs, as a lens does, or into soft spots.",
            domain="choice",
            choices=("disc", "gaussian"),
        ),
        replace(TOLERANCE, former=(("bandwidth", 100 / 255),)),
        *_filter(share=0.3, patch_size=1)[1:],
    ),
    hint="Paint some of what is to stay sharp; the rest of it is found, and what is around is blurred.",
    brushes=(("in", "Keep sharp"),),
    needs=True,
)

MASK = Edit(
    "mask",
    """Select a thing: a soft mask of it from a scribble on it, or from a rough mask.

    Mark some of it and, where the mask takes in too much, some of what is around. Masks are grey pictures of the
    photograph's size, white inside: 8 bits in PNG files, 16 in TIFF files, floats in PFM files, which darktable and ART
    read as raster masks.

    Example: `nlfilter-torch mask in.jpg mask.png --region 190,60,60,60 --background 10,10,40,40`

    A rough mask to a soft one: `nlfilter-torch mask in.jpg mask.tif --mask rough.png`
    """,
    (
        REACH,
        TOLERANCE,
        *(p for p in _filter(share=0.6)[1:] if p.name != "patch_size"),
    ),
)

ABSTRACT = Edit(
    "abstract",
    """Turn a photograph into a painting: flat areas with clear outlines.

    Like a watercolour: `nlfilter-torch abstract in.jpg out.jpg`

    Like a comic: `nlfilter-torch abstract in.jpg out.jpg --edges 1 --tones 8 --bandwidth 50`
    """,
    (
        Parameter(
            "power",
            "number",
            0.1,
            "How much detail goes: 0 none, 0.1 all but outlines, 1 much more.",
            0,
            10,
            domain="not negative",
            zero="0 leaves the image as it is",
            idle=0.0,
            metavar="K",
            slider=Slider("Flatten", 0, 1, 0.01),
        ),
        Parameter(
            "edges",
            "number",
            0.0,
            "Darkness of lines along edges: 0 draws none.",
            0,
            1,
            domain="share",
            idle=0.0,
            metavar="0...1",
            slider=Slider("Lines", 0, 1, 0.05),
        ),
        Parameter(
            "edge_width",
            "number",
            0.2,
            "Width of these lines, in hundredths of the short side.",
            0.01,
            2,
            "%",
            domain="positive",
            least=0.3,  # thinner lines than a pixel can show
            former=(("width", 0.1),),
            slider=Slider("Width of lines", 0.05, 0.6, 0.01),
        ),
        Parameter(
            "tones",
            "count",
            None,
            "Reduce brightness to so many tones. Left out: no such steps.",
            2,
            1 << 16,  # as many as 16 bits have
            domain="count",
            optional=True,
            idle=None,
            metavar="N",
            slider=Slider("Tones", 1, 16, 1, none=1),
        ),
        *_filter(bandwidth="auto", share=0.15, patch_size=3, landmarks=200, auto=True),
    ),
    hint="A painting of the photograph: flat areas with clear outlines.",
)

KNOTS = 17  # of a tone curve
SATURATIONS = 5  # that have a factor of their own
STRAIGHT = tuple(i / (KNOTS - 1) for i in range(KNOTS))


def _curve(channel: str) -> Parameter:
    return Parameter(
        channel,
        "sliders",
        STRAIGHT,
        f"Tone curve of {channel}: what it becomes at equal steps from black to white, with commas between.",
        *GAINS,
        idle=STRAIGHT,
        metavar="V,V,...,V",
    )


LOOK = Edit(
    "look",
    """Put a photograph under a look: tone curves, colours, contrast and details, as another edit had them.

    `nlfilter-torch fit` finds looks from photographs before and after an edit, and `nlfilter-torch apply` takes them.

    Sepia: `nlfilter-torch look in.jpg out.jpg --matrix .39,.77,.19,.35,.69,.17,.27,.53,.13`
    """,
    (
        Parameter(
            "alpha",
            "sliders",
            (1.0, 1.0, 1.0, 1.0),
            "One slider for each layer of detail, as those of `nlfilter-torch detail`. 1 leaves a layer as it is.",
            *GAINS,
            "gain",
            idle=1.0,
            metavar="A,B,...,Z",
        ),
        Parameter(
            "bands",
            "sliders",
            (1.0,) * 7,
            "Strength of what is finer than 1, 2, 5, 9, 18 and 37 pixels, edges too, and of the rest, around the mean "
            "brightness. 1 leaves it as it is.",
            *GAINS,
            "gain",
            idle=(1.0,) * 7,
            metavar="A,B,...,G",
            length=7,
        ),
        _curve("red"),
        _curve("green"),
        _curve("blue"),
        Parameter(
            "matrix",
            "sliders",
            (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            "Three rows of three numbers: how much red, green and blue of the photograph goes into each.",
            *GAINS,
            idle=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
            metavar="RR,RG,...,BB",
            length=9,
        ),
        Parameter(
            "saturation",
            "sliders",
            (1.0,) * SATURATIONS,
            "How many times as far red, green and blue are to be from the largest of them, as saturation in HSV: a "
            "factor for each of five equal steps from grey to pure colours. 1 leaves them as they are.",
            *GAINS,
            "gain",
            idle=(1.0,) * SATURATIONS,
            metavar="A,B,...,E",
        ),
        Parameter(
            "amount",
            "number",
            1.0,
            "How much of the look: 0 none, 1 all of it, 2 twice as much.",
            *GAINS,
            "gain",
            domain="finite",
            slider=Slider("Amount", 0, 2, 0.05, live=False),
        ),
        VIEWING_SIZE,
        *_filter(bandwidth=20.0, share=NEAR, landmarks=300, auto=True, far=True),
    ),
    hint="A look that was found by `nlfilter-torch fit`; load its file, and choose how much of it.",
)

#: All edits, in the order in which the editor adds them to one another.
EDITS: dict[str, Edit] = {
    edit.name: edit for edit in (DENOISE, DETAIL, TONE, SHARPEN, COLORIZE, RECOLOR, DEFOCUS, ABSTRACT, LOOK)
}
