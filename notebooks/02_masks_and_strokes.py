# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Masks and scribbles
#
# A region or a scribble selects all similar pixels, near or far. This gives masks, edits of a single object, and colours that
# spread.

# %%
# %matplotlib inline
import skimage.data
import torch
from kornia.color import rgb_to_grayscale
from skimage.transform import resize

from nlfilter_torch import diffusion_mask, nonlocal_operator
from nlfilter_torch.photo import colorize, enhance, recolor, show_images, show_mask

pixels = resize(skimage.data.astronaut(), (200, 200), anti_aliasing=True)
image = torch.from_numpy(pixels).float().permute(2, 0, 1)[None]


def spot(top: int, left: int, height: int = 8, width: int = 8) -> torch.Tensor:
    """A rectangular mask (1, 1, H, W)."""
    region = torch.zeros(1, 1, *image.shape[2:])
    region[..., top : top + height, left : left + width] = 1
    return region


# %% [markdown]
# ## 1. A region and all similar pixels
#
# The filter compares colours here, so its guide is the whole RGB image. A few pixels of the suit select the suit: both
# arms and the chest, and not the flag, the skin or the background.

# %%
operator = nonlocal_operator(image, photometric_bandwidth=25 / 255, guide_channels="all")
spectrum = operator.spectrum()
suit = spot(117, 24)
mask = diffusion_mask(spectrum, suit, time=3.0, width=2.0)
show_mask(image, suit, mask, side=300)

# %% [markdown]
# ## 2. Diffusion time
#
# Diffusion time sets how far similarity spreads from pixel to pixel. At 0.5 only cloth of the same shade is similar to the
# region, at 3 the folds are too, and at 20 the hair, the skin and the flag begin to be.

# %%
masks = {f"time {time:g}": diffusion_mask(spectrum, suit, time=time, width=2.0) for time in (0.5, 1.0, 3.0, 20.0)}
show_images(masks, side=220)

# %% [markdown]
# ## 3. Sliders for each region
#
# Two regions, two rows of sliders: the suit becomes crisp, the background smooth. The face belongs to neither and is unchanged.

# %%
regions = torch.cat([spot(117, 24), spot(12, 100)], dim=1)
alpha = torch.tensor([[3.0, 3.0, 3.0, 1.0], [0.0, 0.2, 0.5, 1.0]])
show_images({"before": image, "suit crisp, background smooth": enhance(image, alpha, regions)}, side=400)

# %% [markdown]
# ## 4. Another colour
#
# Green scribbles on the suit. Alone they change the red of the flag as well, which is not far from orange; background scribbles
# (black here) prevent that, except for a streak. The luminance is unchanged, and so are folds and shadows.

# %%
strokes = torch.tensor([0.1, 0.6, 0.2]).view(1, 3, 1, 1).expand_as(image)
painted = spot(117, 24) + spot(112, 68, 4, 14)
keep = spot(72, 17, 8, 5) + spot(165, 2, 8, 6) + spot(62, 84)
alone = recolor(image, strokes, painted)
green = recolor(image, strokes, painted, keep=keep)
shown = torch.lerp(image, strokes, painted) * (1 - keep)
show_images({"scribbles, and the background": shown, "without the background": alone, "recoloured": green}, side=300)

# %% [markdown]
# ## 5. Colours for a grey photograph
#
# Here scribbles give the true colours at sixty random positions, and all others are computed. Look at the flag and at the skin:
# an object without a scribble takes the colour of the most similar pixels nearby.

# %%
generator = torch.Generator().manual_seed(3)
places = (torch.rand(60, 2, generator=generator) * 192).long().tolist()
painted = torch.stack([spot(top, left, 6, 6) for top, left in places]).amax(0)
grey = rgb_to_grayscale(image)
coloured = colorize(grey, image, painted)
show_images(
    {
        "grey, with strokes": torch.lerp(grey.expand_as(image), image, painted),
        "colorized": coloured,
        "the original": image,
    },
    side=300,
)
