"""A denoiser around the filter: a small network computes guide and sliders, the filter takes means of alike pixels."""

import math
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlfilter_torch.core.checks import (
    check_image,
    check_photograph,
    check_same_size,
    check_values,
    described,
)
from nlfilter_torch.core.precision import as_given
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.nn.weights import read_weights
from nlfilter_torch.operator.build import operator_from_features

TRAINED = Path(__file__).with_name("denoiser.safetensors")

WIDTH, FEATURES, ORDER = 48, 20, 3  # planes of the network and of the guide; k of the sliders
BEFORE, AFTER = (1, 2, 3, 4), (3,)  # dilations before and after the filter: 33x33 pixels are in sight
PLANES, LEVELS = 3, 2  # of colours, and of the noise in them
PIXELS = 85  # for each landmark
BANDWIDTHS = (0.15, 12.0)  # of the guide, and in pixels, before training
FAINT = 1 / 255  # noise below which less and less is filtered
BRIGHTEST = 2.0  # magnitude that larger images are scaled down to, as the network has seen none

SIDE, STEP = 96, 80  # of tiles, and from one to the next, in pixels
FRAME = 16  # pixels that an image is extended by, so that no border is in sight of it
TOGETHER = 8  # tiles worked on at once


class NonlocalDenoiser(nn.Module):
    """Noisy to denoised, in grey or colour, for noise of known strength that may differ from pixel to pixel.

    A network of convolutions computes, at every pixel, a guide, from which :func:`operator_from_features` builds W, and
    sliders, by which pixels become means of those that the guide finds alike: this removes most of the noise. Further
    convolutions correct what is left. Colours are split into luminance and two differences, so that one network serves
    grey images, whose differences are free of noise. Larger images are worked on in tiles that overlap, at places that
    do not depend on the size of the image.

    A new one knows nothing; :meth:`trained` is the one of the package.

    Example:
        >>> noisy = 0.5 + 0.1 * torch.randn(1, 1, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> denoiser = NonlocalDenoiser.trained()
        >>> with torch.no_grad():
        ...     denoised = denoiser(noisy, 0.1)
        >>> bool((denoised - 0.5).std() < 0.02)
        True
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = _convolution(PLANES + LEVELS, WIDTH)
        self.before = nn.ModuleList(_convolution(WIDTH, WIDTH, dilation) for dilation in BEFORE)
        self.guide = _convolution(WIDTH, FEATURES + LEVELS * (ORDER + 1))
        self.log_bandwidths = nn.Parameter(torch.tensor([math.log(bandwidth) for bandwidth in BANDWIDTHS]))
        self.join = _convolution(WIDTH + 2 * PLANES, WIDTH)
        self.after = nn.ModuleList(_convolution(WIDTH, WIDTH, dilation) for dilation in AFTER)
        self.last = _convolution(WIDTH, PLANES)

    @classmethod
    def trained(
        cls, path: str | Path = TRAINED, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> "NonlocalDenoiser":
        """A denoiser with the weights of a safetensors file; without a path, those of the package.

        Args:
            path: of the file.
            device: where it is to run.
            dtype: in which.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged, or holds weights of something else.
        """
        with torch.device("meta"):
            denoiser = cls()
        weights = read_weights(Path(path), {name: tuple(value.shape) for name, value in denoiser.named_parameters()})
        denoiser.load_state_dict({name: value.to(device, dtype) for name, value in weights.items()}, assign=True)
        return denoiser.eval()

    def forward(self, noisy: Tensor, noise: float | Tensor, *, turns: int = 1) -> Tensor:
        """Remove noise.

        Args:
            noisy: (B, C, H, W) in [0, 1] but for the noise, or one image (C, H, W). Three channels are colours; those
                of another number are denoised one by one.
            noise: its standard deviation in units of the image, as the network expects it: a number, (B,), or a map
                (B, 1 or C, H, W). Where it is 0 the image stays as it is.
            turns: 1, 2 or 4: the result is the mean of as many, each of the image turned by another angle. More take
                longer, and are better by 0.1 or 0.2 dB.

        Returns:
            Of the shape and dtype of ``noisy``. Differentiable in it, in the noise and in the weights.

        Raises:
            TypeError, ValueError: if an argument has another shape, is not finite, or noise is negative.
        """
        if isinstance(noisy, Tensor) and noisy.ndim == 3:
            one = isinstance(noise, Tensor) and noise.ndim == 3
            each = noise.unsqueeze(0) if one else noise  # type: ignore[union-attr]
            return self(noisy.unsqueeze(0), each, turns=turns).squeeze(0)
        check_photograph(noisy, "noisy")
        dtype = self.log_bandwidths.dtype
        levels = noise_map(noise, noisy).to(dtype)
        image = noisy.to(dtype)
        return as_given(image - self.removed(image, levels, turns), noisy)

    def removed(self, image: Tensor, noise: Tensor, turns: int) -> Tensor:
        """What is subtracted from an image (B, C, H, W), of noise (B, 1 or C, H, W), in the dtype of the weights."""
        if turns not in (1, 2, 4):
            raise ValueError(f"turns must be 1, 2 or 4, got {described(turns)}; 1 is fastest")
        quarters = range(0, 4, 4 // turns)

        def mean(tile: Tensor, levels: Tensor) -> Tensor:
            found = [
                self.noise_in(*(planes.rot90(n, (2, 3)) for planes in (tile, levels))).rot90(-n, (2, 3))
                for n in quarters
            ]
            return torch.stack(found).mean(0)

        return in_tiles(image, noise, mean)

    def noise_in(self, noisy: Tensor, noise: Tensor) -> Tensor:
        """What is to be subtracted, all at once: this is trained on crops, and runs on tiles.

        Args:
            noisy: (B, C, H, W).
            noise: (B, 1 or C, H, W).
        """
        if noisy.shape[1] not in (1, 3):
            each = (planes.flatten(0, 1).unsqueeze(1) for planes in (noisy, noise.expand_as(noisy)))
            return self.noise_in(*each).view_as(noisy)
        scale = (noisy.detach().abs().amax((1, 2, 3), keepdim=True) / BRIGHTEST).clamp(min=1.0)
        planes, levels = split_colours(noisy / scale, noise / scale)
        middle = planes.new_tensor([0.5, 0.0, 0.0]).view(1, -1, 1, 1)
        seen = torch.cat([2 * (planes - middle), 10 * levels], dim=1)
        features = self.first(seen.contiguous(memory_format=torch.channels_last))
        for layer in self.before:
            features = features + layer(_bent(features))
        levels = levels[:, (0, 1, 1)]
        found = (planes - self.smooth(features, planes)) * (levels / FAINT).clamp(max=1.0)
        features = self.join(torch.cat([_bent(features), 2 * (planes - found - middle), 2 * found], dim=1))
        for layer in self.after:
            features = features + layer(_bent(features))
        left = self.last(_bent(features))
        return join_colours(found + levels * left.to(planes), noisy.shape[1]) * scale

    def smooth(self, features: Tensor, planes: Tensor) -> Tensor:
        """Means of alike pixels (B, 3, H, W): filtered by the guide and the sliders that features say."""
        height, width = planes.shape[-2:]
        guide, logits = self.guide(_bent(features)).to(planes).split([FEATURES, LEVELS * (ORDER + 1)], dim=1)
        rows, columns = (torch.arange(n, device=guide.device, dtype=guide.dtype) for n in (height, width))
        alike, near = self.log_bandwidths.exp()
        places = torch.stack(torch.meshgrid(rows, columns, indexing="ij")).flatten(1) / near
        operator = operator_from_features(
            torch.cat([guide.flatten(2) / alike, places.expand(len(guide), -1, -1)], dim=1),
            size=(height, width),
            num_landmarks=max(1, height * width // PIXELS),
        )
        # Running sums of shares: the sliders rise to 1 for the smooth layer, so that a pixel becomes a mean of others.
        sliders = logits.unflatten(1, (ORDER + 1, LEVELS)).softmax(1).cumsum(1)[:, :, (0, 1, 1)]
        return (sliders * detail_layers(operator, planes, order=ORDER)).sum(1)


def noise_map(noise: float | Tensor, image: Tensor, name: str = "noise") -> Tensor:
    """Noise of an image (B, C, H, W) as a map (B, 1 or C, H, W), from a number, (B,) or such a map.

    Args:
        noise: standard deviations.
        image: that has them.
        name: of the argument in errors.
    """
    if isinstance(noise, Tensor) and noise.ndim == 4:
        check_image(noise, name, batch=image.shape[0])
        check_same_size(noise, (image.shape[-2], image.shape[-1]), name, "image")
        if noise.shape[1] not in (1, image.shape[1]):
            raise ValueError(
                f"{name} must have 1 channel or as many as the image, {image.shape[1]}, got {noise.shape[1]}; select 1"
            )
        check_values(noise.flatten(), name, "not negative", noise.numel())
        return noise.to(image).expand(image.shape[0], -1, -1, -1)
    check_values(noise, name, "not negative", image.shape[0])
    levels = torch.as_tensor(noise, dtype=image.dtype, device=image.device).reshape(-1, 1, 1, 1)
    return levels.expand(image.shape[0], 1, *image.shape[-2:])


def split_colours(image: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Luminance and two differences of colours (B, 3, H, W), and the noise of luminance and differences (B, 2, H, W).

    The luminance is the mean of the channels. The differences are of unit norm; those of a grey image are 0, and free
    of noise.
    """
    if image.shape[1] == 1:
        nothing = torch.zeros_like(image)
        return torch.cat([image, nothing, nothing], dim=1), torch.cat([noise, torch.zeros_like(noise)], dim=1)
    variance = noise.expand(-1, 3, -1, -1).square()
    deviation = torch.cat([variance.sum(1, keepdim=True) / 9, variance.mean(1, keepdim=True)], dim=1)
    return torch.einsum("pc,bchw->bphw", _mixture(image), image), deviation.clamp(min=1e-30).sqrt()


def join_colours(planes: Tensor, channels: int) -> Tensor:
    """The inverse of :func:`split_colours`."""
    if channels == 1:
        return planes[:, :1]
    return torch.einsum("cp,bphw->bchw", torch.linalg.inv(_mixture(planes)), planes)


def in_tiles(image: Tensor, noise: Tensor, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """What a function makes of an image (B, C, H, W) and its noise, in overlapping tiles, or at once if it is small.

    Tiles stand every ``STEP`` pixels from the upper left corner. Their weights fall to 0 in their outermost pixels, so
    that no border of a tile is in sight.
    """
    height, width = image.shape[-2:]
    below, right = (
        FRAME if n + 2 * FRAME < SIDE else -(-(n + 2 * FRAME - SIDE) // STEP) * STEP + SIDE - n - FRAME
        for n in (height, width)
    )
    padding = (FRAME, right, FRAME, below)
    image, noise = (_extended(planes, padding) for planes in (image, noise))
    rows, columns = image.shape[-2:]
    side = (min(SIDE, rows), min(SIDE, columns))
    places = [
        (row, column) for row in range(0, rows - side[0] + 1, STEP) for column in range(0, columns - side[1] + 1, STEP)
    ]
    if len(places) == 1:
        return function(image, noise)[..., FRAME : FRAME + height, FRAME : FRAME + width]
    fade = torch.outer(*(_profile(n).to(image) for n in side))
    total, weight = torch.zeros_like(image), image.new_zeros(rows, columns)
    batch = len(image)
    for first in range(0, len(places), TOGETHER):
        windows = [
            (..., slice(row, row + side[0]), slice(column, column + side[1]))
            for row, column in places[first : first + TOGETHER]
        ]
        found = function(*(torch.cat([planes[window] for window in windows]) for planes in (image, noise)))
        for window, tile in zip(windows, found.split(batch), strict=True):
            total[window] += fade * tile
            weight[window] += fade
    inner = (..., slice(FRAME, FRAME + height), slice(FRAME, FRAME + width))
    return total[inner] / weight[inner]


def _profile(length: int) -> Tensor:
    """Weights along one direction of a tile: 0 in the frame, then rising to 1 over what tiles have in common."""
    distance = torch.arange(length, dtype=torch.float64) + 0.5
    distance = torch.minimum(distance, length - distance)
    return ((distance - (SIDE - STEP) / 4) / ((SIDE - STEP) / 2)).clamp(1e-4, 1.0)


def _extended(planes: Tensor, padding: tuple[int, int, int, int]) -> Tensor:
    """Planes with mirrored pixels around them, of which narrow ones are mirrored more than once."""
    left, right, above, below = padding
    rows = _mirrored(planes.shape[-2], above, below).to(planes.device)
    columns = _mirrored(planes.shape[-1], left, right).to(planes.device)
    return planes[..., rows, :][..., columns]


def _mirrored(length: int, before: int, after: int) -> Tensor:
    """Numbers of ``length`` pixels, continued on both sides as in a mirror."""
    period = max(1, 2 * length - 2)
    places = torch.arange(-before, length + after) % period
    return torch.minimum(places, period - places)


def _mixture(like: Tensor) -> Tensor:
    """From red, green and blue to luminance and differences, (3, 3)."""
    rows = [[1 / 3, 1 / 3, 1 / 3], [0.5**0.5, 0.0, -(0.5**0.5)], [6**-0.5, -2 * 6**-0.5, 6**-0.5]]
    return like.new_tensor(rows)


def _bent(features: Tensor) -> Tensor:
    """What goes into a convolution; negative features pass weakly, as units would die if they did not."""
    return F.leaky_relu(features, 0.1)


def _convolution(inputs: int, outputs: int, dilation: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=dilation, dilation=dilation)
