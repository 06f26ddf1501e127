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
# From a photograph to its filter, its layers and its sliders, in five steps. The notebook took 7 to 10 seconds of
# processor time on a machine with two cores, including the start of Python.

# %%
# %matplotlib inline
import skimage.data
import torch
from IPython.display import display
from ipywidgets import FloatSlider, interact
from kornia.color import rgb_to_grayscale
from skimage.transform import resize

from nlfilter_torch import captured_energy, detail_layers, nonlocal_operator, polynomial_filter
from nlfilter_torch.photo import plot_response, show_eigenvectors, show_images, show_layers
from nlfilter_torch.photo.picture.colour import edit_luminance

# %% [markdown]
# ## 1. A photograph
#
# Images are tensors `(batch, channels, height, width)` with values from 0 to 1. This one is reduced in size to save time.

# %%
pixels = resize(skimage.data.coffee(), (160, 240), anti_aliasing=True)
image = torch.from_numpy(pixels).float().permute(2, 0, 1)[None]
luminance = rgb_to_grayscale(image)
show_images({"The photograph": image, "Its luminance": luminance}, side=280)

# %% [markdown]
# ## 2. Its filter
#
# The operator W links each of the 38,400 pixels to all others, by the similarity of the 5x5 patches around them. A hundred
# typical patches, the landmarks, represent all of them, so the matrix of more than a billion entries is never formed.
# The diagnostics measure the quality of this approximation: `row_sum_residual` (W averages, so its rows should sum to 1), and
# beta, the share of the picture that the filter's eigenvectors capture.

# %%
operator = nonlocal_operator(luminance)
spectrum = operator.spectrum()
print(f"beta = {captured_energy(spectrum, luminance).item():.4f}")
operator.diagnostics()

# %% [markdown]
# ## 3. Its eigenvectors
#
# The eigenvectors are patterns of the picture itself. The first ones separate large areas of light and dark; later ones pick
# out edges and texture. Each of them connects similar places, even if these are far apart.

# %%
show_eigenvectors(spectrum, numbers=(2, 3, 4, 8, 20, 40), side=280)

# %% [markdown]
# ## 4. Layers and sliders
#
# `I - W` is the finest detail, `W (I - W)` the next, and so on; what remains is smooth. The layers sum to the picture, so
# weighting them edits it. Look at the grain of the wood: the first layer has nearly all of it, the smooth rest none.

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
# ## 5. Move the sliders
#
# Given the layers, an edit is their weighted sum, fast enough for interactive sliders. The curve below the picture is the
# gain of each eigenvalue, a polynomial given by the four sliders. Fine detail is at its left end, smooth shading at its
# right end; the dots are the eigenvalues of this photograph. (The sliders work only while the notebook is running.)


# %%
def edit(fine: float, small: float, large: float, shading: float) -> None:
    alpha = torch.tensor([fine, small, large, shading])
    weighed = (alpha.view(1, -1, 1, 1, 1) * layers).sum(1)
    display(show_images({"before": image, "after": image + weighed - luminance}, side=360))
    display(plot_response(alpha, spectrum))


steps = {"min": 0.0, "max": 5.0, "step": 0.05, "continuous_update": False}
sliders = interact(
    edit,
    fine=FloatSlider(3.0, **steps),
    small=FloatSlider(3.0, **steps),
    large=FloatSlider(4.0, **steps),
    shading=FloatSlider(1.05, **steps),
)

# %% [markdown]
# Next: [regions and strokes](02_masks_and_strokes.ipynb), [fitting sliders to an edit](03_learning_sliders.ipynb).
