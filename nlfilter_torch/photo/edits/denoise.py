"""Denoising by the trained network around the filter, or by sliders set per pixel from the noise level.

Paper: Sec. III, Fig. 6(c), (d); Sec. V.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Literal, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import check_count
from nlfilter_torch.core.precision import per_image
from nlfilter_torch.core.torch_internals import cached_constants
from nlfilter_torch.filtering.filters import weigh_layers
from nlfilter_torch.filtering.noise import is_noise_map
from nlfilter_torch.nn.denoiser.error import standard_error
from nlfilter_torch.nn.denoiser.estimate import white_profile
from nlfilter_torch.nn.denoiser.network import NonlocalDenoiser, deviation_of, level_planes
from nlfilter_torch.nn.denoiser.noise import Noise
from nlfilter_torch.nn.denoiser.profile import NoiseProfile
from nlfilter_torch.nn.denoiser.tiles import STEP
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import Completion, FilterOptions, GuideChannels, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import DENOISE
from nlfilter_torch.photo.edits.noise import HotPixels, hot_pixels_of, noise_of, profile_of
from nlfilter_torch.photo.picture.changes import change_in_parts, remainder
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import InMemory, edited
from nlfilter_torch.photo.picture.measuring import check_in_memory, range_of
from nlfilter_torch.photo.picture.pixels import M, WorkingRange, whole_image
from nlfilter_torch.photo.picture.source import Fitted, Guide, Operator, Pixels, Planes, Source

Method = Literal["network", "rule"]

GUIDE_BLUR = 0.7  # pixels; without the blur, pixels would be similar by their noise
ORDER = 2
LEVELS = 255  # grey levels of white
VISIBLE_LEVELS = 0.5  # change in grey levels that is hardly visible: the rounding error of eight bits
WHITE_LEVELS = 64  # standard deviation in grey levels that is white in a map of the noise
COARSE = 1.2  # coarseness from which noise is called coarse
EVEN = 0.02  # relative difference between the levels in black and white below which they are the same
NO_ESTIMATE = ": too small, too few colours or too much black and white to estimate noise, which --noise-level sets"
GRAIN = 0.2  # share of the finest grain that is kept by default, chosen by eye: at 0.5, traces of JPEG show in it
GRAIN_LEVELS = (2.0, 4.0)  # grey levels of estimated noise between which that share rises from 0; it falls beyond them
NEGLIGIBLE_NOISE = 0.1 / LEVELS  # noise level below what 8 bits resolve; the image is returned unchanged


def denoise(
    image: Tensor,
    *,
    noise_level: float | Tensor | NoiseProfile | None = DENOISE.defaults["noise_level"],
    strength: float | Tensor = DENOISE.defaults["strength"],
    brightness: float | Tensor = DENOISE.defaults["brightness"],
    colour: float | Tensor = DENOISE.defaults["colour"],
    grain: float | Tensor | None = DENOISE.defaults["grain"],
    method: Method = DENOISE.defaults["method"],
    photometric_bandwidth: float | Tensor | None = None,
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = DENOISE.defaults["patch_size"],
    num_landmarks: int = DENOISE.defaults["num_landmarks"],
    landmarks: Sampling = DENOISE.defaults["landmarks"],
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "all",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Remove noise of known or estimated level.

    The network is :meth:`NonlocalDenoiser.trained`. Before it, single pixels that are far from all around them, such as
    hot and dead pixels of sensors, are replaced by the median around them, if they are rare. With ``method="rule"``
    nothing is learned: the sliders of eq. (12) are set for each pixel, to the share of a detail layer's energy that is
    not due to noise. W averages this energy over similar patches in the whole image.

    Args:
        image: (B, C, H, W); with C = 3 it is RGB.
        noise_level: standard deviation of white noise, in units of the image, a number or a tensor of shape () or (B,);
            for the network also a map (B, 1 or C, H, W) or a :class:`NoiseProfile`. None estimates it: for the network
            by :func:`noise_profile`, since the noise of cameras is not white, for the rule as white noise.
        strength: factor of the noise level, a number or a tensor of shape () or (B,): 0 changes nothing, more than 1
            smooths more. For the network, more than 100/255 counts as 100/255 of noise.
        brightness: share of the change of luminance that is made, from 0 to 1, a number or a tensor of shape () or
            (B,): 0 leaves luminance, and with it the grain, unchanged. Of images other than RGB it is the share of the
            whole change. Hot pixels count as noise.
        colour: the same for chroma, the difference between RGB and luminance.
        grain: share of the finest grain that is kept, from 0 to 1, a number or a tensor of shape () or (B,): of the
            luminance of the removed noise, less its mean over 3x3 pixels; of images other than RGB, of each channel.
            None keeps a share that rises from 0 at an estimated level of 2 grey levels to 0.2 at 4 and then falls as
            the level rises, so that the same amount of grain is kept; and none where the level is given or with the
            rule.
        method: ``"network"`` or ``"rule"``. All further arguments are for the rule.
        photometric_bandwidth: h_y; None is the noise level.
        spatial_bandwidth: h_x in pixels; None is 0.2 of the short side.
        patch_size: width of the compared patches.
        num_landmarks: M; more keep more rare detail.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        guide_channels: what the filter of the rule compares, ``"luminance"`` or ``"all"`` channels.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, C, H, W), equal to ``image`` where the noise level is less than a tenth of a grey level. Differentiable in
        image, noise level and shares; an estimated level counts as a constant.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or ``noise_level`` is negative.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> clean = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
        >>> noisy = clean + 0.1 * torch.randn(1, 1, 32, 32, generator=generator)
        >>> bool((denoise(noisy) - clean).std() < 0.03), bool((denoise(noisy, method="rule") - clean).std() < 0.06)
        (True, True)
    """
    return edited(Denoise, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Denoise(PhotoEdit):
    """The edit of :func:`denoise`; ``noise_level`` may also be the estimated noise.

    ``hot_pixels`` are those of the picture, or None if they are not known.
    """

    declared: ClassVar[Edit] = DENOISE
    relative: ClassVar[bool] = True
    filtering: ClassVar[FilterOptions] = FilterOptions(guide_channels="all")
    reports_change: ClassVar[bool] = True
    noise_level: float | Tensor | Noise | NoiseProfile | None
    strength: float | Tensor
    method: Method
    brightness: float | Tensor = DENOISE.defaults["brightness"]
    colour: float | Tensor = DENOISE.defaults["colour"]
    grain: float | Tensor | None = DENOISE.defaults["grain"]
    working: WorkingRange | None = None
    hot_pixels: HotPixels | None = None

    def in_range(self, working: WorkingRange) -> Self:
        """Return the edit with the noise level as the network sees it; an estimated one is already."""
        level = self.noise_level if self.working is not None else _in_range(self.noise_level, working)
        return replace(self, noise_level=level, working=working)

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the network, or the sliders of the rule."""
        DENOISE.check(source.batch, strength=self.strength, brightness=self.brightness, colour=self.colour)
        DENOISE.check(source.batch, grain=self.grain)
        DENOISE.check(method=self.method)
        fitted = self._fit(source)
        return fitted if _are(1, self.brightness, self.colour) else fitted.then(self.in_parts)

    def in_parts(self, image: Tensor, edited: Tensor) -> Tensor:
        """The image with the shares of its change that are made."""
        return change_in_parts(image, edited, brightness=self.brightness, colour=self.colour)

    def _fit(self, source: Source[M]) -> Fitted:
        check_count(self.options.num_landmarks, "num_landmarks")
        is_map = is_noise_map(self.noise_level, source.size)
        if not isinstance(self.noise_level, (Noise, NoiseProfile)) and not is_map:
            DENOISE.check(source.batch, noise_level=self.noise_level)
        hot_pixels = self._hot_pixels_of(source) if self.hot_pixels is None else self.hot_pixels
        edit = self._with(source, hot_pixels)
        noise = edit.noise_level
        assert noise is not None
        if isinstance(noise, NoiseProfile) and len(noise.levels) not in (1, source.batch):
            raise ValueError(
                f"noise_level must be the profile of 1 or {source.batch} images, got {len(noise.levels)}; select some"
            )
        if self.method == "network":
            if is_map:
                check_in_memory(
                    source,
                    "noise_level must be a number for a picture processed in tiles, got a map; denoise it in memory",
                )
            denoising = NetworkDenoising(edit, noise)
            repaired = None if hot_pixels is None else denoising.repaired
            return Fitted(first_channel, denoising.finish, margin=2 * STEP, step=STEP, repaired=repaired)
        if is_map:
            raise ValueError(
                "noise_level must be a number or have shape (B,) for method rule, got a map; use method network"
            )
        level = noise.level if isinstance(noise, (Noise, NoiseProfile)) else torch.as_tensor(noise, dtype=source.dtype)
        level = level.reshape(-1) * torch.as_tensor(self.strength, dtype=source.dtype).reshape(-1)
        return self._fit_rule(source, level)

    def _fit_rule(self, source: Source[M], level: Tensor) -> Fitted:
        assumed, pixels = level.clamp(min=NEGLIGIBLE_NOISE), source.size[0] * source.size[1]
        options = self.filter_options(source.size, fewer_landmarks=True)
        if self.options.photometric_bandwidth is None:
            options = replace(options, photometric_bandwidth=assumed)
        operator = source.operator(Guide(options, blur=GUIDE_BLUR))
        layers = operator.layers(whole_image, ORDER)  # (B, ORDER+1, C, H, W)
        energy = operator.layers(partial(_energy, layers), 1)  # of planes (B, ORDER, H, W)
        noise = assumed.square().reshape(-1, 1) * _noise_in_layers(operator, pixels)  # (B, ORDER)
        denoising = RuleDenoising(layers, energy, noise, level)
        return Fitted(denoising) if self.kept_grain is None else Fitted(denoising, self._finish_rule, margin=1)

    def _finish_rule(self, image: Tensor, denoised: Tensor, _: Inner) -> Tensor:
        return with_grain(image, denoised, self.kept_grain)

    def measured(self, source: Source[M]) -> Self:
        """Return the edit with hot pixels of the picture, and its noise if the level is not set, as it sees both."""
        working = range_of(source)
        if working is None:
            return self._measured(source)
        return self.in_range(working)._measured(source.in_range(working))

    def _measured(self, source: Source[M]) -> Self:
        if self.noise_level is not None and self.hot_pixels is not None:
            return self
        return self._with(source, self._hot_pixels_of(source))

    def _with(self, source: Source[M], hot_pixels: HotPixels | None) -> Self:
        """The edit with the hot pixels of a picture and, if the level is not set, its noise and the grain to keep."""
        if self.noise_level is not None:
            return replace(self, hot_pixels=hot_pixels)
        noise, grain, (least, full) = self._estimated(source, hot_pixels), self.grain, GRAIN_LEVELS
        if grain is None and self.method == "network":
            level = LEVELS * noise.level
            grain = GRAIN * ((level - least) / (full - least)).clamp(0, 1) * full / level.clamp(min=full)
        return replace(self, noise_level=noise, hot_pixels=hot_pixels, grain=grain)

    @property
    def kept_grain(self) -> float | Tensor | None:
        """The share of the finest grain that is kept, or None if it is 0 for all images."""
        return None if _are(0, self.grain) else self.grain

    def _hot_pixels_of(self, source: Source[M]) -> HotPixels | None:
        """The hot pixels of a picture; None if nothing is to be changed, or for the rule."""
        idle = _are(0, self.noise_level) or _are(0, self.strength) or _are(0, self.brightness, self.colour)
        return None if idle or self.method != "network" else hot_pixels_of(source)

    def _estimated(self, source: Source[M], hot_pixels: HotPixels | None) -> Noise | NoiseProfile:
        if self.method != "network":
            return noise_of(source)
        return profile_of(source, None if hot_pixels is None else hot_pixels.removed_at)

    def notes(self, rows: Rows) -> Iterator[str]:
        """Which of both parts a grey photograph does not have."""
        if rows.channels == 3 or _are(0, self.brightness, self.colour):  # the command tells so already
            return
        if _are(0, self.brightness):
            yield f"{rows.name} is grey: with brightness 0 all of its noise is left"
        elif not _are(1, self.colour):
            yield f"{rows.name} is grey: colour changes nothing"

    def map_of(self, image: Tensor) -> Tensor:
        """Levels (B, 3, H, W) of the noise at scales 4, 2 and 1 as red, green and blue, 1 at :data:`WHITE_LEVELS`."""
        seen = image if self.working is None else self.working.seen(image)
        luminance, colour = self._noise.at(seen, (4, 2, 1)).square().unflatten(1, (3, 2)).unbind(2)
        return ((luminance + 2 / 3 * colour).sqrt() * (LEVELS / WHITE_LEVELS)).clamp(0, 1)

    def standard_error(self, image: Tensor, weights: Tensor | None) -> Tensor:
        """Standard errors (B, C, H, W) of the pixels as denoised, kept grain included, with a known noise level."""
        seen = image if self.working is None else self.working.seen(image)
        noise = self.noise_level.at(seen) if isinstance(self.noise_level, Noise) else self.noise_level
        assert noise is not None
        errors = standard_error(partial(self._denoised, weights), seen, noise)
        return errors if self.working is None else errors * self.working.span

    def _denoised(self, weights: Tensor | None, image: Tensor) -> Tensor:
        """An image in the range in which the edit sees it."""
        source = InMemory(image, weights=weights)
        return source.all(self.fit(source, Drawn()))

    @property
    def _noise(self) -> NoiseProfile:
        if isinstance(self.noise_level, NoiseProfile):
            return self.noise_level
        noise = self.noise_level
        return white_profile(noise if isinstance(noise, Noise) else Noise.even(torch.as_tensor([noise])))

    def summary(self, change: float) -> str:
        """The noise, measured or set, and how much the pixels changed."""
        noise, level = self._noise, LEVELS * float(self._noise.level)
        estimated = isinstance(self.noise_level, (Noise, NoiseProfile))
        size, changed = f"{level:.2f} grey levels", super().summary(change)
        least = f"{LEVELS * NEGLIGIBLE_NOISE:.1f}"
        if self.working is not None:  # in which levels are those of a picture that uses the whole range
            change = change / float(self.working.span)
            size, changed = (self.working.described(share / LEVELS) for share in (level, change))
            changed, least = f"pixels changed by {changed} (RMS)", f"{100 * NEGLIGIBLE_NOISE:.2g} %"
        text = f"denoise: {'estimated' if estimated else 'given'} noise of {size}{_described(noise)}"
        grain = 0.0 if self.grain is None else float(self.grain)
        if round(grain, 2) and level >= LEVELS * NEGLIGIBLE_NOISE:
            text += f"; {100 * grain:.0f} % of the finest grain kept (--grain)"
        replaced = 0 if self.hot_pixels is None else int(self.hot_pixels.count.sum())
        if replaced:
            return f"{text}; {replaced} hot or dead pixel{'' if replaced == 1 else 's'} replaced; {changed}"
        if level < LEVELS * NEGLIGIBLE_NOISE:
            hint = NO_ESTIMATE if estimated and not bool(noise.levels.any()) else ""
            return f"{text}, less than {least}; no pixel changed{hint}"
        weak = "" if change >= VISIBLE_LEVELS else ", which is barely visible"
        remedy = ""
        if weak and estimated and 0 < float(self.strength) < 2:  # a clean photograph has nothing more to lose
            if level < VISIBLE_LEVELS:
                remedy = ", as is the noise"
            elif not (_are(0, self.brightness) or _are(0, self.colour)):  # these keep the noise that is left
                remedy = "; --strength 2 removes more"
        return f"{text}; {changed}{weak}{remedy}"


def _are(number: float, *values: object) -> bool:
    """Whether all values are that number, and no tensors."""
    return all(not isinstance(value, Tensor) and value == number for value in values)


def _in_range(level: object, working: WorkingRange) -> float | Tensor | Noise | NoiseProfile | None:
    """A noise level, in units of pictures, as they are seen in their working range."""
    black, span = working.black.flatten(), working.span.flatten()
    if isinstance(level, NoiseProfile):
        return level.in_range(black, span)
    if isinstance(level, Noise):
        floor, gain = (level.floor + level.gain * black) / span.square(), level.gain / span
        return Noise(floor, gain, (level.light - black) / span)
    if isinstance(level, Tensor):
        return level / per_image(span, level, max(1, level.ndim))
    DENOISE.check(noise_level=level)
    return None if level is None else torch.as_tensor(level, dtype=span.dtype) / span


def _described(noise: NoiseProfile) -> str:
    """How noise depends on scale, or else on brightness."""
    coarseness = float(noise.coarseness)
    if coarseness >= COARSE:
        return f", {coarseness:.1f} times as much as white noise in means of 4x4 pixels"
    dark, bright = (LEVELS * float(replace(noise, light=torch.full_like(noise.light, end)).level) for end in (0, 1))
    return f" ({dark:.2f} in black, {bright:.2f} in white)" if abs(dark - bright) > EVEN * max(dark, bright) else ""


@cached_constants
def _network(device: torch.device, dtype: torch.dtype) -> NonlocalDenoiser:
    """Return the trained network with frozen weights."""
    return NonlocalDenoiser.trained(device=device, dtype=dtype).requires_grad_(False)


def first_channel(pixels: Pixels) -> Tensor:
    """The first channel of a picture; the network needs the neighbourhood of a pixel, and sees it afterwards."""
    return pixels.image[:, :1]


@dataclass(frozen=True, eq=False)
class NetworkDenoising:
    """Denoising by the network, with tiles at the same positions in memory and for a picture read by rows."""

    edit: Denoise
    noise: float | Tensor | Noise | NoiseProfile

    def repaired(self, image: Tensor, span: Tensor) -> Tensor:
        """Images whose hot pixels are replaced, as far as the edit changes them, see :attr:`Fitted.repaired`."""
        hot_pixels = self.edit.hot_pixels
        whole = image if hot_pixels is None else hot_pixels.repaired(image, span)
        return whole if _are(1, self.edit.brightness, self.edit.colour) else self.edit.in_parts(image, whole)

    def finish(self, image: Tensor, _: Tensor, inner: Inner) -> Tensor:
        """Denoise an image."""
        image = image if self.edit.hot_pixels is None else self.edit.hot_pixels.removed(image)
        noise = self.noise.at(image) if isinstance(self.noise, Noise) else self.noise
        levels = level_planes(noise, image, "noise_level")
        strength = per_image(self.edit.strength, levels, 4).expand(len(image), -1, -1, -1)
        levels = levels * strength.repeat_interleave(len(levels) // len(image), dim=0)
        levels = torch.where(deviation_of(levels) < NEGLIGIBLE_NOISE, torch.zeros_like(levels), levels)
        grain, network = self.edit.kept_grain, _network(image.device, image.dtype)
        needed = inner if grain is None else _with_neighbours(inner, image.shape[-2:])
        denoised = image - network.estimate_in_tiles(image, levels, turns=1, inner=needed)
        return with_grain(image, denoised, grain)


def with_grain(image: Tensor, denoised: Tensor, grain: float | Tensor | None) -> Tensor:
    """The denoised image with a share of the finest scale of the luminance of what was removed; None is no share."""
    if grain is None:
        return denoised
    removed = reduce_channels(image - denoised, "luminance")
    finest = removed - F.avg_pool2d(removed, 3, 1, padding=1, count_include_pad=False)
    return denoised + per_image(grain, finest, 4) * finest


def _with_neighbours(inner: Inner, size: Sequence[int]) -> Inner:
    """A part of an image, and the pixels beside it."""
    rows, columns = (part.indices(length) for part, length in zip(inner, size, strict=True))
    return slice(max(rows[0] - 1, 0), rows[1] + 1), slice(max(columns[0] - 1, 0), columns[1] + 1)


def _energy(layers: Planes, pixels: Pixels) -> Tensor:
    """Energy of each detail layer but the smooth one."""
    return layers(pixels)[:, :-1].square().mean(2)


@dataclass(frozen=True, eq=False)
class RuleDenoising:
    """Denoising by sliders set for each pixel.

    Attributes:
        layers: detail layers of the picture.
        energy: of the layers but the smooth one, and its mean over similar pixels, as two detail layers.
        noise: variance (B, k) of the noise in each layer.
        level: standard deviation (B,) of the noise.
    """

    layers: Planes
    energy: Planes
    noise: Tensor
    level: Tensor

    def __call__(self, pixels: Pixels) -> Tensor:
        """Denoise pixels."""
        noise = self.noise[..., None, None].to(pixels.image)
        kept = (1 - noise / self.energy(pixels)[:, -1].clamp(min=1e-12)).clamp(0.0, 1.0)
        weighed = weigh_layers(self.layers(pixels), torch.cat([kept, torch.ones_like(kept[:, :1])], dim=1))
        return torch.where((self.level < NEGLIGIBLE_NOISE).reshape(-1, 1, 1, 1), pixels.image, weighed)


def _noise_in_layers(operator: Operator, pixels: int) -> Tensor:
    """Variance (B, ORDER) of unit white noise in each detail layer ``W^i (I - W)``, mean over pixels.

    Outside the span of the eigenvectors W is nearly its diagonal part r, which gives the rest of the trace.
    """
    ritz, support = operator.pairs.ritz, operator.pairs.support
    inside = [ritz.apply(partial(_clamped_gain, order), support) for order in range(ORDER)]
    traces = torch.stack([matrix.diagonal(dim1=1, dim2=2).sum(1) for matrix in inside], dim=1) / pixels
    outside = operator.mean(partial(_gains, operator.of_columns(remainder)))
    return traces.to(outside) + (1 - support.sum(1, keepdim=True) / pixels) * outside


def _gain(order: int, eigenvalues: Tensor) -> Tensor:
    """Gain of the variance of white noise in a detail layer."""
    return (eigenvalues**order * (1 - eigenvalues)).square()


def _clamped_gain(order: int, eigenvalues: Tensor) -> Tensor:
    return _gain(order, eigenvalues.clamp(0.0, 1.0))


def _gains(share: Planes, pixels: Pixels) -> Tensor:
    """Gains of all detail layers, for the diagonal part of W."""
    return torch.cat([_gain(order, share(pixels)) for order in range(ORDER)], dim=1)
