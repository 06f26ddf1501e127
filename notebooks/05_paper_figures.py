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
# # The paper's figures
#
# Counterparts of some figures of *Nonlocal Image Editing* on photographs that ship with scikit-image, small here, so that
# they take seconds. `python -m docs.figures` draws all of them in full size and saves their numbers. This notebook needs
# a checkout of the repository.

# %%
# %matplotlib inline
import inspect

import torch
from IPython.display import Markdown, display

from docs.figures import FIGURES


def draw(name: str, size: int = 128) -> None:
    with torch.no_grad():
        figure, _ = FIGURES[name](size=size)
    display(Markdown(inspect.getdoc(FIGURES[name])))
    display(figure)


# %% [markdown]
# ## Eigenvectors (Fig. 1)

# %%
draw("1")

# %% [markdown]
# ## Sliders (Fig. 6)

# %%
draw("6")

# %% [markdown]
# ## Masks over time (Fig. 11)

# %%
draw("11")

# %% [markdown]
# ## Strokes of colour (Fig. 15)

# %%
draw("15")

# %% [markdown]
# ## Abstraction (Fig. 18)

# %%
draw("18")
