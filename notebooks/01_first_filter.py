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
# # A first filter
#
# From a photograph to its filter, its layers and its sliders, in five steps. Everything here runs in seconds.

# %%
# %matplotlib inline
import skimage.data
import torch
from kornia.color import rgb_to_grayscale
from skimage.transform import resize

from nlfilter_torch import captured_energy, detail_layers, diffusion_mask, nonlocal_operator, polynomial_filter
from nlfilter_torch.colour import edit_luminance
from nlfilter_torch.pictures import plot_response, show_eigenvectors, show_images, show_layers, show_mask

# %% [markdown]
# ## 1. A photograph
#
# Images are tensors `(batch, channels, height, width)` with values from 0 to 1. This one is made smaller, to be quick.

# %%
pixels = resize(skimage.data.coffee(), (160, 240), anti_aliasing=True)
image = torch.from_numpy(pixels).float().permute(2, 0, 1)[None]
luminance = rgb_to_grayscale(image)
show_images({"The photograph": image, "Its luminance": luminance}, side=280)

# %% [markdown]
# ## 2. Its filter
#
# The operator W links each of the 38,400 pixels to all others, by how alike the 5x5 patches around them are. A hundred
# typical patches, the landmarks, stand for all, so that the matrix of more than a thousand million entries never exists. The diagnostics tell
# how good a stand-in that is: look at `row_sum_residual` (W averages, so its rows sum to 1), and at beta, the part of the
# picture that the filter's eigenvectors explain.

# %%
operator = nonlocal_operator(luminance)
spectrum = operator.spectrum()
print(f"beta = {captured_energy(spectrum, luminance).item():.4f}")
operator.diagnostics()

# %% [markdown]
# ## 3. What it sees
#
# The eigenvectors are patterns of the picture itself. The first ones separate large areas of light and dark; later ones pick
# out edges and texture. Note that each of them joins places far apart, wherever the picture is alike.

# %%
show_eigenvectors(spectrum, numbers=(2, 3, 4, 8, 20, 40), side=280)

# %% [markdown]
# ## 4. Layers and sliders
#
# `I - W` is the finest detail, `W (I - W)` the next, and so on; what remains is smooth. The layers sum to the picture, so
# weighing them edits it. Look at the grain of the wood: the first layer has nearly all of it, the smooth rest none.

# %%
layers = detail_layers(operator, luminance)
print(f"largest difference of their sum: {(layers.sum(1) - luminance).abs().max().item():.1e}")
show_layers(layers, side=280)

# %%
alpha = torch.tensor([3.0, 3.0, 4.0, 1.05])
crisp = edit_luminance(image, lambda y: polynomial_filter(operator, y, alpha))
calm = edit_luminance(image, lambda y: polynomial_filter(operator, y, torch.tensor([0.0, 0.3, 1.0, 1.0])))
show_images({"alpha = (3, 3, 4, 1.05)": crisp, "before": image, "alpha = (0, 0.3, 1, 1)": calm}, side=280)

# %% [markdown]
# The four numbers are a polynomial of the eigenvalues: fine detail (left) is made three times as strong, the smooth shading
# (right) nearly left alone.

# %%
plot_response(alpha, spectrum)

# %% [markdown]
# ## 5. One region, and all that looks like it
#
# A few pixels of the saucer are enough: the mask finds what is like them anywhere in the picture. It joins both sides of the
# saucer, the handle and a ring of the coffee of that colour, and leaves out the shadow and most of the table, which is nearly
# as bright. An edit can be limited to it.

# %%
by_colour = nonlocal_operator(image, photometric_bandwidth=20 / 255, guide_channels="all")
region = torch.zeros_like(luminance)
region[..., 85:97, 42:56] = 1
mask = diffusion_mask(by_colour.spectrum(), region, width=3.0)
show_mask(image, region, mask, side=280)
