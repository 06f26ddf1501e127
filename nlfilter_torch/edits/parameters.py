"""The edits and their parameters: everything that functions, commands, files, the editor and the documentation share.

``docs/parameters.md`` is made from it (``python -m benchmarks.parameters docs/parameters.md``).
"""

from dataclasses import replace

from nlfilter_torch.edits.declaration import Edit, Parameter, Slider
from nlfilter_torch.edits.look_parameters import LOOK
from nlfilter_torch.edits.shared_parameters import (
    LIMITS,
    REACH,
    REACH_SLIDER,
    TOLERANCE,
    VIEWING_SIZE,
    WITHOUT_SHADING,
    choice,
    filter_parameters,
    gain,
    reach_of_time,
    sliders,
)

CRISP = (2.2, 2.2, 2.2, 1.0)

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
        sliders(
            "alpha",
            CRISP,
            "One slider for each layer, from the finest detail to the smooth shading, with commas between. 1 leaves a "
            "layer as it is, 3 makes it three times as strong, 0 takes it away.",
            idle=1.0,
            metavar="A,B,...,Z",
        ),
        sliders(
            "inside",
            None,
            "The sliders inside what looks like the strokes; as many. Left out: 1 for each.",
            optional=True,
            is_option=False,  # --region has them
        ),
        gain(
            "residual",
            None,
            "Strength of the grain that no typical patch explains. 1 leaves it as it is, which keeps noise down. "
            "Left out: as the first slider of --alpha.",
            optional=True,
            idle=None,
        ),
        choice(
            "channels",
            ("luminance", "all"),
            "Edit brightness and keep the colours, or edit red, green and blue alike, colours too.",
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
        *WITHOUT_SHADING,
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
        gain(
            "amount",
            4.0,
            "Strength: 1 leaves the photograph as it is, 4 is visible, 8 is strong.",
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
        *filter_parameters(bandwidth=10.0, auto=True),
    ),
    hint="Sharper edges without more noise.",
)

TONE = Edit(
    "tone",
    """Raise or lower contrast without a change of colour or of mean brightness, but where the picture clips.

    Example: `nlfilter-torch tone in.jpg out.jpg --contrast 1.2 --clarity 2`
    """,
    (
        gain(
            "contrast",
            1.2,
            "Contrast of the smooth shading: 1 leaves it, 1.4 is strong, 0.7 flattens.",
            idle=1.0,
            slider=Slider("Contrast", 0.5, 1.5, 0.05, live=False),
        ),
        gain(
            "clarity",
            1.0,
            "Contrast of the largest details on it: 1 leaves it, 4 is strong.",
            idle=1.0,
            slider=Slider("Clarity", 0, 5, 0.1, live=False),
        ),
        LIMITS,
        VIEWING_SIZE,
        *WITHOUT_SHADING,
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
        choice(
            "method",
            ("network", "rule"),
            "`network`: trained on photographs. `rule`: by sliders of the filter, which the options below are for.",
        ),
        *filter_parameters(share=0.2, landmarks=200),
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
        *filter_parameters(share=1.2, patch_size=1)[1:],
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
        choice(
            "method",
            ("regression", "kmeans"),
            "Soft colours that mix between strokes, or one flat colour for each of as many pieces (k-means).",
        ),
        VIEWING_SIZE,
        *filter_parameters(bandwidth=40.0, share=0.5625)[:4],
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
        choice(
            "aperture",
            ("disc", "gaussian"),
            "Turn dots into discs, as a lens does, or into soft spots.",
        ),
        replace(TOLERANCE, former=(("bandwidth", 100 / 255),)),
        *filter_parameters(share=0.3, patch_size=1)[1:],
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
        *(p for p in filter_parameters(share=0.6)[1:] if p.name != "patch_size"),
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
        VIEWING_SIZE,
        *filter_parameters(bandwidth="auto", share=0.15, patch_size=3, landmarks=200, auto=True),
    ),
    hint="A painting of the photograph: flat areas with clear outlines.",
)

#: All edits, in the order in which the editor adds them to one another.
EDITS: dict[str, Edit] = {
    edit.name: edit for edit in (DENOISE, DETAIL, TONE, SHARPEN, COLORIZE, RECOLOR, DEFOCUS, ABSTRACT, LOOK)
}
