"""A denoiser: in each of two passes, a small network computes guide and sliders for a filter of similar pixels."""

import math
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlfilter_torch.core.blocks import EVERYWHERE, Inner
from nlfilter_torch.core.checks import (
    check_count,
    check_image,
    check_photograph,
    described,
)
from nlfilter_torch.core.kernels.convolution import SLOPE, channels_last, convolve
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.torch_internals import in_format_of, outside_transforms, refuse_transforms
from nlfilter_torch.core.workers import threads_for
from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.noise import noise_map
from nlfilter_torch.nn.denoiser.profile import NoiseProfile, join_colours, split_colours, split_noise
from nlfilter_torch.nn.denoiser.tiles import in_tiles
from nlfilter_torch.nn.denoiser.weights import read_weights
from nlfilter_torch.operator.build import operator_from_points
from nlfilter_torch.operator.options import FilterOptions

TRAINED = Path(__file__).with_name("denoiser.safetensors")

WIDTH, FEATURES, ORDER = 48, 20, 3  # channels of the network and of the guide; order k of the sliders
BEFORE, AFTER = (1, 2, 3, 4), (3,)  # dilations before and after the filter; the receptive field of a pass is 33x33
PASSES = 2
PLANES, LEVELS = 3, 2  # colour planes, and noise levels for them
SCALES = (1, 2, 4)  # sides in pixels of the blocks whose noise the network is told
PIXELS, ROUGH_PIXELS = 85, 200  # pixels per landmark, in the last pass and in those before it
BANDWIDTHS = (0.15, 12.0)  # initial bandwidths: of the guide, and in pixels
FAINT = 1 / 255  # noise level below which filtering is reduced in proportion
LARGEST, AROUND = 3.0, 8  # largest plausible correction, in noise levels, and the radius around others, in pixels
BRIGHTEST = 2.0  # images of larger magnitude, which do not occur in training, are scaled down to this
NOISIEST = 100 / 255  # noise levels above this are reduced to it: trained up to 60/255, it would lose contrast


class Layer(nn.Conv2d):
    """Convolution with 3x3 weights of features that first pass through a leaky rectifier."""

    def __init__(self, inputs: int, outputs: int, dilation: int = 1) -> None:
        super().__init__(inputs, outputs, 3, padding=dilation, dilation=dilation)

    def forward(self, features: Tensor, added: Tensor | None = None) -> Tensor:
        """Convolve features (B, C, H, W), and add others (B, O, H, W)."""
        return convolve(features, self.weight, self.bias, self.dilation[0], added)


class NonlocalDenoiser(nn.Module):
    """Denoiser for grey or colour images with noise of known strength, which may vary by pixel and by scale.

    A convolutional network computes two things at every pixel: a guide, from which :func:`operator_from_features`
    builds W, and sliders for a filter that averages pixels with similar guides. The filter removes most of the noise,
    and further convolutions correct its result. A second pass with the same weights starts from the features of that
    result, so that its guide is almost free of noise; where it diverges, which rare patterns cause, the first result is
    kept. Colours are split into luminance and two differences, so that the same network handles grey images, whose
    differences are free of noise. Larger images are processed in overlapping tiles, whose positions do not depend on
    the size of the image.

    A new instance is untrained; :meth:`trained` loads the weights of the package.

    Args:
        passes: how often the network and its filter are applied. The weights of the package are trained for two; one
            is faster, and needs weights trained for it.

    Example:
        >>> noisy = 0.5 + 0.1 * torch.randn(1, 1, 32, 32, generator=torch.Generator().manual_seed(0))
        >>> denoiser = NonlocalDenoiser.trained()
        >>> with torch.no_grad():
        ...     denoised = denoiser(noisy, 0.1)
        >>> bool((denoised - 0.5).std() < 0.02)
        True
    """

    def __init__(self, passes: int = PASSES) -> None:
        super().__init__()
        check_count(passes, "passes")
        self.passes = passes
        self.first = nn.Conv2d(PLANES + LEVELS * len(SCALES), WIDTH, 3, padding=1)
        self.before = nn.ModuleList(Layer(WIDTH, WIDTH, dilation) for dilation in BEFORE)
        self.guide = Layer(WIDTH, FEATURES + LEVELS * (ORDER + 1))
        self.log_bandwidths = nn.Parameter(torch.tensor([math.log(bandwidth) for bandwidth in BANDWIDTHS]))
        self.join = nn.Conv2d(WIDTH + 2 * PLANES, WIDTH, 3, padding=1)
        self.after = nn.ModuleList(Layer(WIDTH, WIDTH, dilation) for dilation in AFTER)
        self.last = Layer(WIDTH, PLANES)
        self.again = nn.Conv2d(WIDTH, WIDTH, 1).requires_grad_(passes > 1)  # a single pass does not use it
        for weight in self.again.parameters():
            nn.init.zeros_(weight)  # every pass is like the first, until it is trained

    @classmethod
    def trained(
        cls, path: str | Path = TRAINED, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> "NonlocalDenoiser":
        """Load a trained denoiser from a safetensors file.

        Args:
            path: the file; by default the weights of the package.
            device: of the denoiser.
            dtype: of the denoiser.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is damaged, or holds weights of a different model.
        """
        with torch.device("meta"):
            denoiser = cls()
        weights = read_weights(Path(path), shapes_of(denoiser))
        denoiser.load_state_dict({name: value.to(device, dtype) for name, value in weights.items()}, assign=True)
        return denoiser.eval()

    @outside_transforms
    def forward(self, noisy: Tensor, noise: float | Tensor | NoiseProfile, *, turns: int = 1) -> Tensor:
        """Remove noise.

        Args:
            noisy: (B, C, H, W), in [0, 1] apart from the noise, or one image (C, H, W). Three channels are treated as
                colours; any other number of channels are denoised one by one.
            noise: standard deviation of white noise in units of the image: a number, (B,), or a map (B, 1 or C, H, W);
                or the profile of other noise. More than 100/255 counts as 100/255. Where it is 0 in all channels the
                image is unchanged.
            turns: 1, 2 or 4: number of results to average, each from the image rotated by a different angle. More take
                longer and are better by about 0.1 dB.

        Returns:
            The denoised image, with the shape and dtype of ``noisy``, also if this is an empty batch. Differentiable in
            image, noise and weights.

        Raises:
            TypeError, ValueError: if an argument has the wrong shape or is not finite, or noise is negative.
        """
        refuse_transforms(noisy=noisy, noise=noise, weights=tuple(self.parameters()))
        if isinstance(noisy, Tensor) and noisy.ndim == 3:
            is_map = isinstance(noise, Tensor) and noise.ndim == 3
            batched = noise.unsqueeze(0) if is_map else noise  # type: ignore[union-attr]
            return self(noisy.unsqueeze(0), batched, turns=turns).squeeze(0)
        check_image(noisy, "noisy", empty=True)
        if len(noisy) == 0:
            return noisy.clone()
        check_photograph(noisy, "noisy")
        dtype = self.log_bandwidths.dtype
        image = noisy.to(dtype)
        return in_format_of(image - self.estimate_in_tiles(image, level_planes(noise, image), turns), noisy)

    def estimate_in_tiles(self, image: Tensor, levels: Tensor, turns: int, inner: Inner = EVERYWHERE) -> Tensor:
        """Estimate the noise of an image (B, C, H, W) from its :func:`level_planes`, both in the weights' dtype.

        Values outside ``inner`` are unspecified.
        """
        check_count(turns, "turns")
        if turns not in (1, 2, 4):
            raise ValueError(f"turns must be 1, 2 or 4, got {described(turns)}; 1 is fastest")
        pictures = _one_by_one(image)
        function = partial(self._mean_estimate, range(0, 4, 4 // turns))
        workers = threads_for(pictures, levels, *self.parameters())
        estimate = in_tiles(pictures, levels, function, inner, workers=workers)
        return estimate.view_as(image)

    def _mean_estimate(self, quarters: range, tile: Tensor, levels: Tensor) -> Tensor:
        """Mean of the estimates of a tile's noise, each from the tile rotated by so many quarters of a turn."""
        estimates = [
            self.estimate_noise(*(planes.rot90(n, (2, 3)) for planes in (tile, levels))).rot90(-n, (2, 3))
            for n in quarters
        ]
        return torch.stack(estimates).mean(0)

    def estimate_noise(self, noisy: Tensor, levels: Tensor) -> Tensor:
        """Estimate the noise without dividing the image: called with crops in training, with tiles otherwise.

        Args:
            noisy: (B, 1 or 3, H, W).
            levels: (B, 6, H, W), as from :func:`level_planes`.
        """
        scale = (noisy.detach().abs().amax((1, 2, 3), keepdim=True) / BRIGHTEST).clamp(min=1.0)
        planes = split_colours(noisy / scale)
        levels, *coarser = _bounded(levels / scale, noisy.shape[1]).split(LEVELS, dim=1)
        # White noise has equal levels at all scales: what the network learns of their differences does not affect it.
        seen = torch.cat([_centred(planes), 10 * levels, *(10 * (other - levels) for other in coarser)], dim=1)
        first = self.first(channels_last(seen))
        levels = levels[:, (0, 1, 1)]
        pixels, *others = [ROUGH_PIXELS] * (self.passes - 1) + [PIXELS]
        features, estimate, _ = self._pass(first, planes, levels, pixels)
        for pixels in others:
            again = first + self.again(F.leaky_relu(features, SLOPE))
            features, refined, corrections = self._pass(again, planes, levels, pixels)
            estimate = torch.lerp(estimate, refined, _trust(corrections[:, : noisy.shape[1]]).to(refined))
        return join_colours(estimate, noisy.shape[1]) * scale

    def _pass(self, features: Tensor, planes: Tensor, levels: Tensor, pixels: int) -> tuple[Tensor, Tensor, Tensor]:
        """Apply the network and its filter once.

        Args:
            features: of the noisy planes, and of the result of the previous pass if there is one.
            planes: noisy luminance and colour differences (B, 3, H, W).
            levels: noise of each plane.
            pixels: per landmark.

        Returns:
            Features, the estimated noise of each plane, and the last corrections of it in noise levels.
        """
        for layer in self.before:
            features = layer(features, features)
        estimate = (planes - self.smooth(features, planes, pixels)) * (levels / FAINT).clamp(max=1.0)
        both = channels_last(torch.cat([_centred(planes - estimate), 2 * estimate], dim=1))
        weights = self.join.weight.split([WIDTH, 2 * PLANES], dim=1)
        rest = F.conv2d(both, weights[1], self.join.bias, padding=1)
        features = convolve(features, weights[0], added=rest)
        for layer in self.after:
            features = layer(features, features)
        corrections = self.last(features).to(planes)
        return features, estimate + levels * corrections.clamp(-LARGEST, LARGEST), corrections

    def smooth(self, features: Tensor, planes: Tensor, pixels: int) -> Tensor:
        """Filter planes (B, 3, H, W) with a guide and sliders computed from ``features``, averaging similar pixels.

        The filter has a landmark for every so many ``pixels``.
        """
        height, width = planes.shape[-2:]
        guide, logits = self._guide_of(features.to(planes)).split([FEATURES, LEVELS * (ORDER + 1)], dim=1)
        rows, columns = (torch.arange(n, device=guide.device, dtype=guide.dtype) for n in (height, width))
        alike, near = self.log_bandwidths.exp()
        places = torch.stack(torch.meshgrid(rows, columns, indexing="ij")).flatten(1) / near
        operator = operator_from_points(
            torch.cat([guide.flatten(2) / alike, places.expand(len(guide), -1, -1)], dim=1),
            (height, width),
            FilterOptions(num_landmarks=max(1, height * width // pixels)),
        )
        # Cumulative sums: the sliders increase to 1 for the smooth layer, so that the filter computes means of pixels.
        sliders = logits.unflatten(1, (ORDER + 1, LEVELS)).softmax(1).cumsum(1)[:, :, (0, 1, 1)]
        return (sliders * detail_layers(operator, planes, order=ORDER)).sum(1)

    @full_precision
    def _guide_of(self, features: Tensor) -> Tensor:
        """Guide and sliders before their normalisation, (B, FEATURES + LEVELS (ORDER + 1), H, W)."""
        output: Tensor = self.guide(features)
        return output


def shapes_of(denoiser: NonlocalDenoiser) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the weights."""
    return {name: tuple(value.shape) for name, value in denoiser.named_parameters()}


def level_planes(noise: float | Tensor | NoiseProfile, image: Tensor, name: str = "noise") -> Tensor:
    """Expand noise to levels at each pixel of an image (B, C, H, W), as the network is told them.

    Args:
        noise: standard deviation of white noise, a number, (B,) or a map (B, 1 or C, H, W), or the profile of noise.
        image: its channels count as images of their own unless they are 1 or 3.
        name: of the argument, in errors.

    Returns:
        (B or B * C, 6, H, W): levels of luminance and colour differences at the first of :data:`SCALES`, then at the
        next.
    """
    channels = image.shape[1]
    if isinstance(noise, NoiseProfile):
        if channels in (1, 3):
            return noise.at(image, SCALES)
        levels = noise.at(image, SCALES).unflatten(1, (-1, LEVELS))
        grey = torch.stack([levels[:, :, 0], torch.zeros_like(levels[:, :, 0])], dim=2).flatten(1, 2)
        return grey.repeat_interleave(channels, dim=0)
    levels = noise_map(noise, image, name)
    if channels not in (1, 3):
        levels, channels = levels.expand_as(image).flatten(0, 1).unsqueeze(1), 1
    return split_noise(levels, channels).repeat(1, len(SCALES), 1, 1)


def deviation_of(levels: Tensor) -> Tensor:
    """Standard deviation (B, 1, H, W) of the noise of each channel, from :func:`level_planes`; no gradient."""
    luminance, colour = levels.detach()[:, :LEVELS].square().split(1, dim=1)
    return (luminance + 2 / 3 * colour).sqrt()  # the variances of two differences of unit norm, in three channels


def _one_by_one(image: Tensor) -> Tensor:
    """The channels (B * C, 1, H, W) of an image, unless it is grey or in colour."""
    return image if image.shape[1] in (1, 3) else image.flatten(0, 1).unsqueeze(1)


def _bounded(levels: Tensor, channels: int) -> Tensor:
    """Reduce levels (B, 6, H, W) at all scales where those of a pixel exceed :data:`NOISIEST` per channel."""
    limit = levels.new_tensor([NOISIEST / math.sqrt(channels), NOISIEST]).view(1, -1, 1, 1)
    excess = (levels[:, :LEVELS] / limit).clamp(min=1.0)
    return levels / excess.repeat(1, len(SCALES), 1, 1)


def _centred(planes: Tensor) -> Tensor:
    """Planes (B, 3, H, W) as the network sees them, in [-1, 1]."""
    return 2 * (planes - planes.new_tensor([0.5, 0.0, 0.0]).view(1, -1, 1, 1))


def _trust(corrections: Tensor) -> Tensor:
    """1 where all corrections (B, C, H, W) nearby are plausible, 0 where one exceeds the limit by a noise level."""
    largest = corrections.abs().amax(1, keepdim=True)
    for size, padding in (((2 * AROUND + 1, 1), (AROUND, 0)), ((1, 2 * AROUND + 1), (0, AROUND))):
        largest = F.max_pool2d(largest, size, stride=1, padding=padding)
    return (1 + LARGEST - largest).clamp(0.0, 1.0)
