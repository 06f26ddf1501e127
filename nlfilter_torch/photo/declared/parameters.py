"""Declarations of all edits and their parameters, for functions, commands, files, the editor and the documentation.

``docs/parameters.md`` is generated from them (``python -m docs.parameters docs/parameters.md``).
"""

from dataclasses import replace

from nlfilter_torch.photo.declared.declaration import (
    FILTER_PANEL,
    GAINS,
    USUAL_GAINS,
    Condition,
    Edit,
    Parameter,
    Scribble,
    Slider,
)
from nlfilter_torch.photo.declared.development import LIGHT_PARAMETERS
from nlfilter_torch.photo.declared.shared_parameters import (
    COLOUR_TOLERANCE,
    EXTENT,
    LIMITS,
    LOOK,
    REGION_REACH,
    REGION_REACH_SLIDER,
    VIEWING_SIZE,
    WITHOUT_SHADING,
    choice,
    filter_parameters,
    gain,
    number,
    part,
    sliders,
)

CRISP = (2.2, 2.2, 2.2, 1.0)
PAINT = Scribble(
    "stroke_mask",
    "Paint",
    "colours",
    needed=True,
    advice="give --strokes FILE or --region X,Y,W,H:COLOUR, such as --region 40,60,20,20:red",
)
ADD = Scribble(
    "added",
    "Brush",
    role="added",
    option="--add",
    option_help="A rectangle to add to the mask, as with a brush, whatever is found. May be repeated.",
    gradients=("linear", "radial"),
)
REMOVE = Scribble(
    "removed",
    "Eraser",
    role="removed",
    option="--remove",
    option_help="A rectangle that is not selected, as by an eraser, whatever is found or added. May be repeated.",
)
BOX_HELP = "A rectangle around the whole object, outside which nothing is selected; --region may be left out then."
BOX = Scribble("box", "Around it", role="box", option="--box", option_help=BOX_HELP)
BACKGROUND = Scribble(
    "background",
    "Not this",
    role="background",
    option="--background",
    option_help="A rectangle of the background, where too much is selected. May be repeated.",
)
BESIDE_OBJECTS = (BACKGROUND, BOX, ADD, REMOVE)  # what masks of objects take beside scribbles on them

DETAIL = Edit(
    "detail",
    """Strengthen or weaken the details of a photograph, with one slider for each size of detail.

    Where nothing clips, only brightness changes. The file keeps its depth, transparency, colour profile and camera
    metadata (EXIF). Photographs that do not fit in memory are processed in tiles, preferably from TIFF files or zarr
    arrays, which are read in parts.

    Sharpen strongly: `nlfilter-torch detail in.jpg out.jpg --alpha 3,3,3,1`

    Apply a preset (see `nlfilter-torch presets`): `nlfilter-torch detail in.jpg out.jpg --preset crisp`

    Smooth skin or noise: `nlfilter-torch detail in.jpg out.jpg --alpha 0.2,0.5,1,1 --bandwidth 10`

    Sharpen everything that resembles a rectangle: `nlfilter-torch detail in.jpg out.jpg --region 60,300,20,20`

    Apply a preset with a space in its name: `nlfilter-torch detail in.jpg out.jpg --preset "soft skin"`

    Apply a fitted edit: `nlfilter-torch detail in.jpg out.jpg --preset look.json` (see `nlfilter-torch fit`)
    """,
    (
        sliders(
            "alpha",
            CRISP,
            "One slider for each layer, from the finest detail to the smooth shading, separated by commas. 1 leaves a "
            "layer unchanged, 3 makes it three times as strong, 0 removes it.",
            idle=1.0,
            usual=USUAL_GAINS,
            metavar="A,B,...,Z",
        ),
        sliders(
            "inside",
            None,
            "The sliders inside the region selected by the strokes, as many as in alpha. Default: 1 for each.",
            optional=True,
            is_option=False,  # given by --region
            is_argument=False,
        ),
        gain(
            "residual",
            None,
            "Strength of the grain that the typical patches do not capture. 1 leaves it unchanged, which keeps noise "
            "down. Default: the first slider of --alpha.",
            optional=True,
            idle=None,
            panel=FILTER_PANEL,
            usual=USUAL_GAINS,
        ),
        choice(
            "channels",
            ("luminance", "all"),
            "`luminance`: edit brightness and keep the colours. `all`: edit red, green and blue, colours too.",
        ),
        replace(REGION_REACH, slider=REGION_REACH_SLIDER),
        EXTENT,
        replace(COLOUR_TOLERANCE, argument="mask_bandwidth"),
        number(
            "threshold",
            5.0,
            "Detail with less contrast than this is strengthened less, since it may be noise: a standard deviation in "
            "grey levels of 255. 0 strengthens all detail equally.",
            (0, 255),
            "levels",
            domain="not negative",
            zero_meaning="pass 0 to strengthen all detail equally",
            per_image=True,
        ),
        LIMITS,
        VIEWING_SIZE,
        *WITHOUT_SHADING,
    ),
    function="enhance",
    hint="Paint on an area to give it its own sliders; everything that resembles it is selected too.",
    scribbles=(
        Scribble("regions", "Edit this", "sliders"),
        replace(BACKGROUND, argument="negative"),
        replace(BOX, kind="sliders"),
        replace(ADD, kind="sliders"),
        REMOVE,
    ),
    presets=("look",),
)

SHARPEN = Edit(
    "sharpen",
    """Sharpen a photograph but not its noise, with one slider instead of those of `nlfilter-torch detail`.

    Example: `nlfilter-torch sharpen in.jpg out.jpg --amount 5`
    """,
    (
        number(
            "amount",
            4.0,
            "Strength: 1 leaves the photograph unchanged, 4 is visible, 8 is strong.",
            GAINS,
            domain="finite",
            idle=1.0,
            slider=Slider("Amount", 0, 10, 0.5),
            usual=USUAL_GAINS,
            per_image=True,
        ),
        number(
            "guide_blur",
            1.2,
            "Blur that hides noise and the finest grain from the filter, so that they are not sharpened. 0: no blur.",
            (0, 1e4),
            "px",
            domain="not negative",
            zero_meaning="pass 0 to leave the guide unblurred",
            slider=Slider("Ignored grain", 0, 4, 0.1, live=False),
        ),
        LIMITS,
        VIEWING_SIZE,
        *filter_parameters(bandwidth=10.0, auto=True),
    ),
    hint="Sharper edges without more noise.",
)

TONE = Edit(
    "tone",
    """Raise or lower contrast without changing colours or mean brightness, except where the picture clips.

    Example: `nlfilter-torch tone in.jpg out.jpg --contrast 1.2 --clarity 2`
    """,
    (
        gain(
            "contrast",
            1.2,
            "Contrast of the smooth shading: 1 leaves it unchanged, 1.4 is strong, 0.7 flattens it.",
            idle=1.0,
            slider=Slider("Contrast", 0.5, 1.5, 0.05),
            usual=(0.2, 3.0),
        ),
        gain(
            "clarity",
            1.0,
            "Contrast of the largest details: 1 leaves it unchanged, 4 is strong.",
            idle=1.0,
            slider=Slider("Clarity", 0, 5, 0.1),
            usual=USUAL_GAINS,
        ),
        LIMITS,
        VIEWING_SIZE,
        *WITHOUT_SHADING,
    ),
    function="adjust_tone",
    hint="Contrast of large shapes, and of the largest details on them.",
)

LIGHT = Edit(
    "light",
    """Change light, white balance, tones and colours of a part of a photograph; `nlfilter-torch develop` changes all.

    The part is an object, of which some is marked, or a gradient.

    Darken the sky: `nlfilter-torch light in.jpg out.jpg --exposure -1 --linear 0,0,0,50%`

    Warmer light on a face: `nlfilter-torch light in.jpg out.jpg --warmth 0.3 --shadows 0.4 --radial 40%,20%,20%,30%`

    An object alone: `nlfilter-torch light in.jpg out.jpg --exposure 0.7 --box 150,30,200,300`
    """,
    (
        *LIGHT_PARAMETERS,
        REGION_REACH,
        replace(EXTENT, default="object"),
        COLOUR_TOLERANCE,
        *filter_parameters(share=0.3, patch_size=1)[1:],
    ),
    function="adjust_light",
    hint="Paint on some of an object, or drag a gradient; only that part changes.",
    scribbles=(
        Scribble(
            "region",
            "Change this",
            needed=True,
            advice="give --linear X,Y,X,Y, --radial X,Y,W,H, --region X,Y,W,H, --box X,Y,W,H or --mask FILE to mark "
            "what changes, such as --linear 0,0,0,50%; nlfilter-torch develop changes all of the photograph",
        ),
        *BESIDE_OBJECTS,
    ),
)

HEAL = Edit(
    "heal",
    """Remove small blemishes, such as dust and pimples: paint over them, and similar patches nearby replace them.

    Example: `nlfilter-torch heal in.jpg out.jpg --region 420,215,9,9 --region ellipse:60,80,12,10`
    """,
    (
        number(
            "reach",
            6.0,
            "How far similar patches are searched, in radii of the spot.",
            (1, 20),
            domain="positive",
            slider=Slider("Search", 2, 20, 1),
        ),
    ),
    hint="Paint over small blemishes; patches from nearby replace them.",
    scribbles=(
        Scribble(
            "spots",
            "Heal this",
            needed=True,
            advice="give --region X,Y,W,H, --strokes FILE or --mask FILE to mark the spots, such as "
            "--region 190,60,9,9",
        ),
    ),
)

DENOISE = Edit(
    "denoise",
    """Remove noise from a photograph.

    The noise level, and how it depends on brightness, are estimated from the photograph.

    Example: `nlfilter-torch denoise in.jpg out.jpg`

    Gently: `nlfilter-torch denoise in.jpg out.jpg --strength 0.6`

    Coloured noise only, and keep the grain: `nlfilter-torch denoise in.jpg out.jpg --brightness 0`
    """,
    (
        number(
            "strength",
            1.0,
            "How much noise is removed: 1 removes the estimated or given noise, less leaves some, more smooths detail.",
            (0, 4),
            domain="not negative",
            zero_meaning="0 changes nothing",
            idle=0.0,
            slider=Slider("Strength", 0, 2, 0.05, knots=(0, 0.5, 1, 2)),
            per_image=True,
        ),
        part(
            "brightness",
            "Share of the noise in brightness that is removed: 1 is all, 0 leaves brightness unchanged.",
            "In brightness",
        ),
        part(
            "colour",
            "Share of the noise in colour that is removed: 1 is all, 0 leaves the colours unchanged.",
            "In colour",
        ),
        number(
            "grain",
            None,
            "Share of the finest grain of brightness that is kept. Default: up to 0.2 for estimated noise of more than "
            "2 grey levels, else 0.",
            (0, 1),
            domain="share",
            optional=True,
            metavar="0...1",
            slider=Slider("Grain", -0.05, 1, 0.05, none=-0.05, none_text="automatic", live=False),
            per_image=True,
        ),
        number(
            "noise_level",
            None,
            "Standard deviation of the noise in grey levels of 255. Default: estimated from the photograph.",
            (0, 255),
            "levels",
            domain="not negative",
            zero_meaning="0 changes nothing",
            optional=True,
            per_image=True,
        ),
        choice(
            "method",
            ("network", "rule"),
            "`network`: trained on photographs. `rule`: sliders of the filter, to which the options below apply.",
        ),
        *filter_parameters(share=0.2, landmarks=200),
    ),
    hint="Estimates the noise and removes as much of it as you choose.",
    map_help="Also write a picture of the noise at every pixel: blue is its standard deviation, green and red those of "
    "means of 2x2 and 4x4 pixels, times 2 and 4. White noise is grey, coarse noise red; 255 is 64 grey levels.",
    error_help="Also write the standard error of every denoised pixel as a TIFF of 32 bits, in shares of white: 1.645 "
    "times it to either side is meant to hold the true value of 90 % of the pixels. Takes five times as long.",
    filter_condition=Condition(
        "method", "rule", "has no effect on the network; add --method rule to denoise by the filter alone"
    ),
)

RECOLOR = Edit(
    "recolor",
    """Recolour an object: paint some colour on it, and the rest of it and similar objects nearby take that colour.

    The object also takes the brightness of the colour, unless --brightness is 0. Everything unlike the object stays
    exactly the same; mark what is alike but must keep its colour with --keep. Photographs that do not fit in memory are
    processed in tiles, preferably from TIFF files or zarr arrays, which are read in parts.

    Turn a red car blue: `nlfilter-torch recolor in.jpg out.jpg --region 420,215,14,14:blue`

    Keep the brightness of the car: `nlfilter-torch recolor in.jpg out.jpg --region 420,215,14,14:blue --brightness 0`

    Keep the wood unchanged: `nlfilter-torch recolor in.jpg out.jpg --strokes paint.png --keep 60,100,20,20`
    """,
    (
        number(
            "reach",
            0.6,
            "How far the colour spreads to less similar areas. 0 stays close, 0.95 goes far.",
            (0, 0.999),
            domain="below 1",
            metavar="0...1",
            slider=Slider("Reach", 0, 0.95, 0.05),
            panel=FILTER_PANEL,
            per_image=True,
        ),
        replace(EXTENT, default="object"),
        number(
            "brightness",
            1.0,
            "Whose brightness the object has: 1 takes that of the colour, so that yellow becomes red and white becomes "
            "blue, 0 keeps its own. Its shading remains.",
            (0, 1),
            domain="share",
            metavar="0...1",
            slider=Slider("Brightness of the colour", 0, 1, 0.05),
            per_image=True,
        ),
        replace(COLOUR_TOLERANCE, slider=Slider("Tolerance", 3, 40, 1, live=False)),
        *filter_parameters(share=1.2, patch_size=1)[1:],
    ),
    hint="Choose a colour and paint some of it on an object; similar areas take it too.",
    scribbles=(
        PAINT,
        Scribble(
            "keep",
            "Keep as it is",
            role="background",
            option="--keep",
            option_help="A rectangle; everything that resembles it stays unchanged. May be repeated.",
        ),
        replace(BOX, kind="colours"),
        replace(ADD, kind="colours"),
        REMOVE,
    ),
)

COLORIZE = Edit(
    "colorize",
    """Colourise a grey photograph: paint some strokes, and their colours spread over similar areas nearby.

    Brightness stays unchanged. A colour photograph is treated as a grey one: its own colours are replaced. Photographs
    that do not fit in memory are processed in tiles, by regression only, preferably from TIFF files or zarr arrays,
    which are read in parts.

    Example: `nlfilter-torch colorize grey.jpg out.jpg --strokes paint.png`

    Without painting: `nlfilter-torch colorize grey.jpg out.jpg --region 10,10,30,30:skyblue --region 10,300,9,9:green`
    """,
    (
        number(
            "strength",
            1.0,
            "How much colour is given to areas that resemble no stroke: 1 colours everything, 0 leaves them grey.",
            (0, 1),
            domain="share",
            metavar="0...1",
            slider=Slider("Fill", 0, 1, 0.05),
            per_image=True,
        ),
        choice(
            "method",
            ("regression", "kmeans"),
            "`regression`: soft colours that mix between strokes. `kmeans`: segments of one flat colour each.",
        ),
        VIEWING_SIZE,
        *filter_parameters(bandwidth=40.0, share=0.7, patch_size=1)[:4],
    ),
    hint="For grey photographs: paint some colours, and they spread over similar areas nearby.",
    scribbles=(
        PAINT,
        replace(BOX, option_help="A rectangle around what is coloured; outside it the photograph stays grey."),
    ),
    coloured=True,
)

DEFOCUS = Edit(
    "defocus",
    """Blur a photograph as a wide aperture would, except for the object that you mark.

    Mark some of it, or of each of its parts; the rest of it is found automatically. If parts of the background stay
    sharp, mark some of them with --background.

    Example: `nlfilter-torch defocus in.jpg out.jpg --region 190,60,60,60 --region 60,260,40,180`

    Blur what resembles a rectangle: `nlfilter-torch defocus in.jpg out.jpg --region 190,60,60,60 --background 9,9,9,9`
    """,
    (
        number(
            "radius",
            2.5,
            "Radius of the strongest blur, in hundredths of the short side.",
            (0.1, 20),
            "%",
            domain="positive",
            slider=Slider("Blur", 0.5, 10, 0.1),
        ),
        choice(
            "aperture",
            ("disc", "gaussian"),
            "`disc`: points of light become discs, as in a lens. `gaussian`: they become soft spots.",
        ),
        replace(EXTENT, default="object"),
        REGION_REACH,
        COLOUR_TOLERANCE,
        *filter_parameters(share=0.3, patch_size=1)[1:],
    ),
    hint="Paint on some of the object to keep sharp; the rest of it is found, and the background is blurred.",
    scribbles=(
        Scribble(
            "focus_region",
            "Keep sharp",
            needed=True,
            advice="give --region X,Y,W,H, --box X,Y,W,H or --mask FILE to mark what stays sharp, such as "
            "--region 190,60,60,60",
        ),
        replace(BACKGROUND, label="Blur this"),
        *BESIDE_OBJECTS[1:],
    ),
)

MASK = Edit(
    "mask",
    """Select an object: compute a soft mask of it from a scribble on it, or from a rough mask.

    Mark some of it and, where the mask covers too much, some of the background. Masks are grey pictures of the
    photograph's size, white inside: 8 bits in PNG files, 16 in TIFF files, floats in PFM files, which darktable and ART
    read as raster masks.

    Example: `nlfilter-torch mask in.jpg mask.png --region 190,60,60,60 --background 10,10,40,40`

    Refine a rough mask: `nlfilter-torch mask in.jpg mask.tif --mask rough.png`

    Cut the object out: `nlfilter-torch mask in.jpg mask.png --box 150,30,200,300 --cutout object.png`
    """,
    (
        REGION_REACH,
        replace(EXTENT, default="object"),
        COLOUR_TOLERANCE,
        *(p for p in filter_parameters(share=0.3)[1:] if p.name != "patch_size"),
    ),
    function="region_mask",
    scribbles=(
        Scribble(
            "scribbles",
            "Select this",
            needed=True,
            advice="give --region X,Y,W,H, --box X,Y,W,H or --mask FILE to mark the object, such as "
            "--region 190,60,60,60",
        ),
        *BESIDE_OBJECTS,
    ),
)

ABSTRACT = Edit(
    "abstract",
    """Turn a photograph into a painting: flat areas with clear outlines.

    Like a watercolour: `nlfilter-torch abstract in.jpg out.jpg`

    Like a comic: `nlfilter-torch abstract in.jpg out.jpg --edges 1 --tones 8 --bandwidth 25`
    """,
    (
        number(
            "power",
            0.3,
            "How much detail is removed. 0: none, 0.3: all but outlines, 1: much more.",
            (0, 10),
            domain="up to 10",
            zero_meaning="pass 0 to leave the image unchanged",
            idle=0.0,
            metavar="K",
            slider=Slider("Flatten", 0, 1, 0.01),
            per_image=True,
        ),
        number(
            "edges",
            0.0,
            "Darkness of lines along edges: 0 draws none.",
            (0, 1),
            domain="share",
            idle=0.0,
            metavar="0...1",
            slider=Slider("Lines", 0, 1, 0.05),
        ),
        number(
            "edge_width",
            0.2,
            "Width of the lines along edges, in hundredths of the short side.",
            (0.01, 2),
            "%",
            domain="positive",
            min_pixels=0.3,  # thinnest line that pixels can show
            slider=Slider("Width of lines", 0.05, 0.6, 0.01),
        ),
        Parameter(
            "tones",
            "count",
            None,
            "Number of tones to which brightness is reduced. Default: no reduction.",
            2,
            1 << 16,  # levels of 16 bits
            domain="count",
            optional=True,
            idle=None,
            metavar="N",
            slider=Slider("Tones", 1, 16, 1, none=1, none_text="all"),
        ),
        VIEWING_SIZE,
        *filter_parameters(bandwidth="auto", share=0.15, patch_size=3, landmarks=200, auto=True),
    ),
    hint="Turns the photograph into a painting: flat areas with clear outlines.",
)

#: All edits, in the order in which the editor applies them.
EDITS: dict[str, Edit] = {
    edit.name: edit
    for edit in (HEAL, DENOISE, LIGHT, DETAIL, TONE, SHARPEN, COLORIZE, RECOLOR, DEFOCUS, ABSTRACT, LOOK)
}
