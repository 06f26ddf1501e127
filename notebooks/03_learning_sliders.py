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
# # Fitting sliders
#
# A photograph was edited in another program. Which sliders have the same effect? Least squares finds them, or gradient
# descent where least squares is not enough, and they are saved for other photographs.

# %%
# %matplotlib inline
import skimage.data
import torch
from kornia.color import rgb_to_grayscale
from skimage.filters import unsharp_mask
from skimage.transform import resize

from nlfilter_torch import estimate_bandwidth, fit_alpha, nonlocal_operator, polynomial_filter
from nlfilter_torch.photo import PRESETS, Recipe, Step, apply_recipe, plot_response, show_images
from nlfilter_torch.photo.picture.colour import edit_luminance


def load(name: str, height: int, width: int) -> torch.Tensor:
    """A photograph (1, 3, H, W) in [0, 1]."""
    pixels = resize(getattr(skimage.data, name)(), (height, width), anti_aliasing=True)
    return torch.from_numpy(pixels).float().permute(2, 0, 1)[None]


image, other = load("chelsea", 160, 240), load("coffee", 160, 240)
luminance = rgb_to_grayscale(image)

# %% [markdown]
# ## 1. An edit from elsewhere
#
# An unsharp mask of scikit-image with radius 2, which is unrelated to this filter.

# %%
sharpened = unsharp_mask(luminance[0, 0].numpy(), radius=2.0, amount=1.5)
target = torch.from_numpy(sharpened).view_as(luminance).to(luminance)
edited = edit_luminance(image, lambda _: target)
show_images({"before": image, "the edit": edited}, side=380)

# %% [markdown]
# ## 2. Its sliders, in one step
#
# The filter is linear in its sliders, so the best ones solve a small least-squares problem. The fit is not exact: an unsharp
# mask depends on nearby pixels, this filter on similar ones. The printed percentage is the share of the change that the
# sliders reproduce.

# %%
operator = nonlocal_operator(luminance)
alpha = fit_alpha(operator, luminance, target)[0]
by_sliders = polynomial_filter(operator, luminance, alpha)
left, change = ((target - x).square().sum() for x in (by_sliders, luminance))
print("alpha:", [round(a, 2) for a in alpha.tolist()])
print(f"explained: {100 * (1 - left / change):.1f} % of the change")
show_images({"the edit": edited, "by the sliders": edit_luminance(image, lambda _: by_sliders)}, side=380)

# %%
plot_response(alpha, operator.spectrum())

# %% [markdown]
# ## 3. Saved, and used on another photograph
#
# A preset contains the sliders and the parameters of their filter. Written to a file, it is applied by
# `nlfilter-torch detail photo.jpg out.jpg --preset look.json`.

# %%
look = Recipe((Step("detail", alpha=tuple(round(a, 3) for a in alpha.tolist())),))
print(look.to_json(complete=True))
show_images({"another photograph": other, "with the same look": apply_recipe(look, other)}, side=380)

# %% [markdown]
# Named presets take one line of code, or `--preset NAME` on the command line.

# %%
names = ("crisp", "dramatic", "glow", "soft skin", "calm", "smooth")
show_images({name: apply_recipe(PRESETS[name], other) for name in names}, columns=3, side=260)

# %% [markdown]
# ## 4. The filter itself, by gradient descent
#
# Least squares finds sliders, but not the bandwidth, the difference up to which two patches count as similar. The fit is
# differentiable, so the bandwidth can follow the gradient of the error that the best sliders leave.

# %%
logarithm = estimate_bandwidth(luminance).log().requires_grad_()
optimizer = torch.optim.Adam([logarithm], lr=0.1)
for step in range(12):
    trial = nonlocal_operator(luminance, photometric_bandwidth=logarithm.exp())
    learned = polynomial_filter(trial, luminance, fit_alpha(trial, luminance, target, rounding=0.0))
    unexplained = (learned - target).square().sum() / change
    if step % 4 == 0 or step == 11:
        print(f"{255 * logarithm.exp().item():5.1f} grey levels explain {100 * (1 - unexplained.item()):.1f} %")
    optimizer.zero_grad()
    unexplained.backward()
    optimizer.step()

# %%
show_images({"the edit": edited, "learned": edit_luminance(image, lambda _: learned.detach())}, side=380)

# %% [markdown]
# In [the next notebook](04_inside_a_network.ipynb), sliders, bandwidths and a network that computes the guide are trained
# together.
