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
# # Inside a network
#
# The filter is a layer like any other. Here two small convolutions compute the guide from a noisy image, the filter averages
# pixels that are similar in the guide, and everything is trained together: convolutions, sliders and bandwidths.

# %%
# %matplotlib inline
import skimage.data
import torch
from matplotlib.figure import Figure
from skimage.color import rgb2gray
from torch import nn

from nlfilter_torch import NonlocalFilter
from nlfilter_torch.photo import show_images

NOISE = 25 / 255

# %% [markdown]
# ## 1. The network
#
# Two convolutions and the filter. `learn=` names the parameters of the filter to train; bandwidths stay positive.


# %%
class Denoiser(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.guide = nn.Sequential(nn.Conv2d(1, 16, 5, padding=2), nn.ReLU(), nn.Conv2d(16, 8, 5, padding=2))
        self.filter = NonlocalFilter(
            alpha=(0.2, 0.8, 1.0),
            learn=("alpha", "photometric_bandwidth", "spatial_bandwidth"),
            patch_size=1,  # the convolutions cover neighbouring pixels
            photometric_bandwidth=0.2,
            spatial_bandwidth=10.0,
            num_landmarks=32,
        )

    def forward(self, noisy: torch.Tensor) -> torch.Tensor:
        return self.filter(noisy, guide=self.guide(noisy))


with torch.random.fork_rng():
    torch.manual_seed(0)
    network = Denoiser()
network

# %% [markdown]
# ## 2. Crops with noise

# %%
generator = torch.Generator().manual_seed(0)
pictures = [
    torch.from_numpy(rgb2gray(getattr(skimage.data, name)())).float() for name in ("astronaut", "rocket", "cat")
]


def noisy(clean: torch.Tensor) -> torch.Tensor:
    return clean + NOISE * torch.randn(clean.shape, generator=generator)


def crops(count: int = 4, side: int = 48) -> torch.Tensor:
    chosen = []
    for _ in range(count):
        picture = pictures[int(torch.randint(len(pictures), (), generator=generator))]
        top, left = (int(torch.randint(n - side, (), generator=generator)) for n in picture.shape)
        chosen.append(picture[top : top + side, left : left + side])
    return torch.stack(chosen)[:, None]


def psnr(clean: torch.Tensor, denoised: torch.Tensor) -> float:
    return -10 * float((clean - denoised).square().mean().log10())


# %% [markdown]
# ## 3. Training
#
# An ordinary loop. Gradients of the Sinkhorn balancing are implicit and do not divide by differences of eigenvalues, so clipping and
# warm-up are not needed.

# %%
test = torch.from_numpy(rgb2gray(skimage.data.chelsea())).float()[None, None, 60:180, 110:290]
test_noisy = noisy(test)
with torch.no_grad():
    untrained = network(test_noisy)

optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
gains = []
for _ in range(100):
    clean = crops()
    degraded = noisy(clean)
    denoised = network(degraded)
    loss = (denoised - clean).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    gains.append(psnr(clean, denoised.detach()) - psnr(clean, degraded))

figure = Figure(figsize=(7, 3), layout="constrained")
axis = figure.subplots()
axis.plot(gains, linewidth=0.5, label="each step")
axis.plot(range(19, len(gains)), torch.tensor(gains).unfold(0, 20, 1).mean(1), label="mean of twenty")
axis.legend()
axis.set(xlabel="step", ylabel="dB", title="What the network gains on the noisy crops of each step")
axis.grid(alpha=0.3)
figure

# %% [markdown]
# ## 4. On a picture that was not used in training
#
# Look at the whiskers and at the skin between the eyes: noise disappears where the guide makes many pixels similar. This is the
# result of a few seconds of training with few landmarks; more landmarks at test time help. `denoise` uses a network that was
# trained for longer, `NonlocalDenoiser`; `python -m benchmarks.training` trains it.

# %%
network.filter.affinity.num_landmarks = 300
with torch.no_grad():
    trained = network(test_noisy)
panels = {"noisy": test_noisy, "untrained": untrained, "trained": trained, "clean": test}
show_images(
    {f"{title}, {psnr(test, panel):.1f} dB" if title != "clean" else title: panel for title, panel in panels.items()},
    columns=2,
    side=420,
)

# %% [markdown]
# ## 5. The guide
#
# The guide has eight channels; these are three of them as red, green and blue. The filter treats areas of the same colour as
# similar.

# %%
with torch.no_grad():
    guide = network.guide(test_noisy)[:, :3]
low, high = guide.amin((2, 3), keepdim=True), guide.amax((2, 3), keepdim=True)
print(network.filter)
show_images({"guide, three channels": (guide - low) / (high - low)}, side=420)
