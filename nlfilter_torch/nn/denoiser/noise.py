"""The noise of a photograph: its estimation from the flattest windows."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import mirrored, order_by, reflected
from nlfilter_torch.core.checks import check_image
from nlfilter_torch.core.precision import full_precision, squarable, working_dtype
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import GuideChannels

WINDOW_SIZE = 9  # side of a window in pixels
NUM_WINDOWS = 6144
FLAT_SHARE = 0.06  # share of the windows in which noise is measured: those with the smallest slopes
BRIGHTNESS_GROUPS = 6  # groups of windows by brightness, for noise that depends on it
MEDIAN = 0.6745  # median of the absolute value of a standard normal variable
CLIPPED_SHARE = 0.1  # share of clipped pixels above which the noise of a window counts as truncated
TRUNCATED_SHARE = 0.5  # share of such windows above which a group does not count
TEXTURE_RATIO = 1.1  # ratio to the expected variance above which a group is assumed to contain texture
MIN_IMPROVEMENT = 0.15  # decrease of the squared relative errors that is required of a dependence on brightness
MIN_FLOOR_RATIO = 0.02  # least ratio of the variance in the dark to the growth of variance up to white
MIN_VARIANCE = 1e-12


@dataclass(frozen=True)
class Noise:
    """White noise whose variance grows with brightness, as in cameras: ``floor + gain * light``.

    Attributes:
        floor: variance (B,) in the dark.
        gain: growth (B,) of the variance up to white.
        light: mean brightness (B,) of the photograph.
    """

    floor: Tensor
    gain: Tensor
    light: Tensor

    @classmethod
    def even(cls, level: Tensor) -> "Noise":
        """Return noise with the same standard deviation (B,) everywhere."""
        return cls(level.square(), torch.zeros_like(level), torch.zeros_like(level))

    @property
    def level(self) -> Tensor:
        """Standard deviation (B,) at the mean brightness."""
        return (self.floor + self.gain * self.light).sqrt()

    def at(self, image: Tensor) -> Tensor:
        """Standard deviation (B, C, H, W) at the pixels of an image, with brightness the mean of 5x5 pixels."""
        light = F.avg_pool2d(image.detach(), 5, 1, padding=2, count_include_pad=False).clamp(0, 1)
        floor, gain = (value.to(image).view(-1, 1, 1, 1) for value in (self.floor, self.gain))
        return (floor + gain * light).sqrt()


@full_precision
def estimate_noise(image: Tensor) -> Tensor:
    """Estimate the standard deviation of white noise, at the mean brightness if it depends on brightness.

    Of many windows of 9x9 pixels, those whose local means have the smallest slopes are used. The estimate is their
    median response to Immerkaer's mask ("Fast Noise Variance Estimation", 1996), which is zero for anything linear in
    rows or columns. It is robust to slopes, and to clipped pixels in parts of the image; texture that fills the whole
    picture biases it by one or two grey levels.

    Args:
        image: (B, C, H, W).

    Returns:
        (B,), in units of the image; 0 for an image smaller than 3x3. No gradient is propagated.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point (B, C, H, W) tensor.

    Example:
        >>> noise = torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> estimate_noise(0.5 + 0.1 * noise).round(decimals=2)
        tensor([0.1000])
    """
    check_image(image, "image")
    pixels = image.detach().to(working_dtype(image))
    size = image.shape[-2], image.shape[-1]
    return Noise(*measured_noise(size, pixels.flatten(2)[:, :, window_places(size)], "all")).level


@torch.no_grad()
def measured_noise(size: tuple[int, int], colours: Tensor, channels: GuideChannels) -> Tensor:
    """Estimate floor, gain and light of :class:`Noise`, (3, B), of a picture of size (H, W).

    ``colours`` (B, C, n) are those of its pixels at :func:`window_places`.
    """
    if min(size) < 3:
        return torch.zeros(3, len(colours), dtype=colours.dtype)
    windows = _windows(size, squarable(colours), channels)
    light = windows.mean((2, 3))
    response = _response(windows)
    # Clipping truncates the noise: windows with many clipped pixels come last.
    truncated = (windows == 0).logical_or(windows == 1).to(light).mean((2, 3)) > CLIPPED_SHARE
    slopes = torch.where(truncated, torch.inf, _slopes(windows))
    level, _ = _level(response, slopes, light)
    brightness, variances, counts = [], [], []
    for group in order_by(light, slopes).tensor_split(BRIGHTNESS_GROUPS, dim=1):
        if group.shape[1] == 0:
            continue  # fewer windows than groups
        inside = group[..., None].expand(-1, -1, response.shape[2])
        deviation, mean_light = _level(response.gather(1, inside), slopes.gather(1, group), light.gather(1, group))
        brightness.append(mean_light)
        variances.append(deviation.square())
        counts.append(truncated.gather(1, group).to(light).mean(1) <= TRUNCATED_SHARE)
    counted = torch.stack(counts, dim=1)
    counted |= ~counted.any(1, keepdim=True)
    floor, gain = _fit_line(torch.stack(brightness, dim=1), torch.stack(variances, dim=1), counted.to(light))
    even = gain == 0
    return torch.stack([torch.where(even, level.square(), floor), gain, light.mean(1)])


def window_places(size: tuple[int, int]) -> Tensor:
    """Ascending row-major indices (n,) of the pixels in which the noise of a picture (H, W) is measured."""
    return _window_pixels(size).sort().values


def _window_pixels(size: tuple[int, int]) -> Tensor:
    """Row-major indices of the pixels of windows at random positions, window by window; the same for every call.

    Mirror images of a window are windows, too: the noise of a picture that is flipped or transposed is the same.
    """
    height, width = size
    rows, columns = max(1, height - WINDOW_SIZE + 1), max(1, width - WINDOW_SIZE + 1)
    inside = torch.arange(WINDOW_SIZE)
    if rows * columns <= NUM_WINDOWS:
        corners = torch.arange(rows * columns)
        down = reflected((corners // columns)[:, None] + inside, height)
        across = reflected((corners % columns)[:, None] + inside, width)
        return (down[:, :, None] * width + across[:, None, :]).flatten()
    short, long = sorted((rows, columns))
    count = NUM_WINDOWS // (8 if rows == columns else 4)
    corners = torch.randint(short * long, (count,), generator=torch.Generator().manual_seed(0))
    sides = sorted(size)
    down = reflected((corners // long)[:, None] + inside, sides[0])
    across = reflected((corners % long)[:, None] + inside, sides[1])
    down, across = torch.broadcast_tensors(down[:, :, None], across[:, None, :])
    return mirrored(down, across, size).flatten()


def _windows(size: tuple[int, int], colours: Tensor, channels: GuideChannels) -> Tensor:
    """Windows (B, C * n, WINDOW_SIZE, WINDOW_SIZE), from the colours of the pixels at :func:`window_places`."""
    order = _window_pixels(size).sort().indices
    reduced = reduce_channels(colours.unsqueeze(3), channels).squeeze(3)
    return reduced[:, :, order.argsort().to(colours.device)].unflatten(2, (-1, WINDOW_SIZE, WINDOW_SIZE)).flatten(1, 2)


def _response(windows: Tensor) -> Tensor:
    """Absolute response (B, n, 49) to Immerkaer's mask, which has unit norm."""
    second = windows.new_tensor([1.0, -2.0, 1.0])
    mask = torch.outer(second, second)[None, None] / 6
    return F.conv2d(windows.flatten(0, 1).unsqueeze(1), mask).abs().flatten(1).unflatten(0, windows.shape[:2])


def _slopes(windows: Tensor) -> Tensor:
    """Mean squared slopes (B, n) of local means, which hardly depend on what the mask responds to."""
    means = F.avg_pool2d(windows.flatten(0, 1).unsqueeze(1), 5, 1)
    down, across = means[..., 2:, 1:-1] - means[..., :-2, 1:-1], means[..., 1:-1, 2:] - means[..., 1:-1, :-2]
    return (down.square() + across.square()).mean((1, 2, 3)).unflatten(0, windows.shape[:2])


def _level(response: Tensor, slopes: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Noise level (B,) from responses (B, n, r) in windows with the smallest slopes (B, n), and their brightness."""
    count = max(1, min(slopes.shape[1], max(20, int(FLAT_SHARE * slopes.shape[1]))))
    least = order_by(slopes, light)[:, :count]
    responses = response.gather(1, least[..., None].expand(-1, -1, response.shape[2]))
    return responses.flatten(1).median(1).values / MEDIAN, light.gather(1, least).mean(1)


def _fit_line(light: Tensor, variance: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Fit floor and gain (B,), not negative, to variances (B, K) over brightness (B, K), with weights ``counted``.

    The gain is 0 unless it reduces the error enough. Texture only adds variance, so points above the line have less
    weight.
    """
    variance = variance.clamp(min=MIN_VARIANCE)
    weight = counted
    for _ in range(10):
        scale = weight / variance.square()
        ones, linear, square = scale.sum(1), (scale * light).sum(1), (scale * light.square()).sum(1)
        constant, rising = (scale * variance).sum(1), (scale * variance * light).sum(1)
        determinant = (ones * square - linear.square()).clamp(min=1e-30)
        floor = (constant * square - rising * linear) / determinant
        gain = (ones * rising - constant * linear) / determinant
        floor, gain = (
            torch.where(gain <= 0, constant / ones, torch.where(floor <= 0, 0.0, floor)),
            torch.where(gain <= 0, 0.0, torch.where(floor <= 0, rising / square, gain)),
        )
        expected = floor[:, None] + gain[:, None] * light
        weight = counted * torch.where(variance > TEXTURE_RATIO * expected, 0.2, 1.0).to(variance)
    even = (constant / ones)[:, None]
    errors = [((fitted - variance) / variance).square().mul(weight).sum(1) for fitted in (even, expected)]
    depends = errors[0] - errors[1] > MIN_IMPROVEMENT
    return torch.where(depends, floor.maximum(MIN_FLOOR_RATIO * gain), even[:, 0]), torch.where(depends, gain, 0.0)
