"""Examples of the training: clean and noisy crops, and the levels of the noise that the network is told."""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import Dataset

from benchmarks.training.cameras import Camera
from benchmarks.training.crops import Crops
from benchmarks.training.pictures import Draws, Pictures
from nlfilter_torch.nn.denoiser.network import SCALES, level_planes
from nlfilter_torch.nn.denoiser.profile import profile_of_difference

SHARES = {"white": 0.52, "camera": 0.42, "clean": 0.06}  # of the examples
LARGEST = 60 / 255  # standard deviation of white noise
MISSTATED = 0.25  # share of examples whose given levels are not the actual ones
RATIOS = 0.75, 1.35  # range of given over actual levels, in these
UNEVEN = 0.12  # deviation of the logarithm of this ratio between scales, and luminance and colour, of cameras
FAINTEST = 2 / 255  # levels that are told of clean crops, at most
MARGIN = 8  # pixels around a crop in which the noise of a camera is measured, too


@dataclass(frozen=True)
class Examples:
    """A batch.

    Attributes:
        clean, noisy: crops (B, 1 or 3, side, side).
        levels: (B, 6, side, side), see :func:`level_planes`.
    """

    clean: Tensor
    noisy: Tensor
    levels: Tensor

    @classmethod
    def joined(cls, batches: list[Self]) -> Self:
        """One batch of several."""
        columns = zip(*((batch.clean, batch.noisy, batch.levels) for batch in batches), strict=True)
        return cls(*(torch.cat(column) for column in columns))

    def to(self, device: torch.device | str) -> "Examples":
        """The same examples on a device."""
        return Examples(*(planes.to(device, non_blocking=True) for planes in (self.clean, self.noisy, self.levels)))

    def pin_memory(self) -> "Examples":
        """The same examples in memory from which copies to a GPU are fast; called by DataLoader."""
        return Examples(self.clean.pin_memory(), self.noisy.pin_memory(), self.levels.pin_memory())


class Batches(Dataset[Examples]):
    """The batches of a training, each reproducible from a seed and its number; every other one is in grey.

    Args:
        pictures: from which crops are.
        side: of the crops, in pixels.
        seed: of all random numbers.
        count: of examples in a batch.
        parts: how many examples are taken from each photograph by a camera; it divides ``count``.
    """

    def __init__(self, pictures: Pictures, side: int, seed: int, count: int, parts: int = 1) -> None:
        self.pictures, self.side, self.seed, self.count, self.parts = pictures, side, seed, count, parts

    def __getitem__(self, number: int) -> Examples:
        source = Source(self.pictures, self.side, (self.seed << 32) + number, parts=self.parts)
        return source.batch(self.count, grey=number % 2 == 0)


class Source:
    """Random examples, reproducible from a seed.

    Args:
        pictures: from which crops are.
        side: of the crops, in pixels.
        seed: of all random numbers.
        exact: whether given levels are always the actual ones, for judging.
        parts: how many examples are taken from each photograph by a camera, which takes far longer than cutting them.
    """

    def __init__(self, pictures: Pictures, side: int, seed: int, *, exact: bool = False, parts: int = 1) -> None:
        self.pictures, self.side, self.exact, self.parts = pictures, side, exact, parts
        self.draws = Draws(seed)
        self.crops = Crops(pictures, side, self.draws)
        self.makers = {"white": self.white, "camera": self.camera, "clean": self.unchanged}

    def batch(self, count: int, *, grey: bool, kind: str | None = None) -> Examples:
        """Examples of all kinds or of one, in grey or in colour; a multiple of ``parts``."""
        groups = count // self.parts
        shares = torch.tensor(list(SHARES.values())).expand(groups, -1)
        drawn = torch.multinomial(shares, 1, generator=self.draws.generator).flatten().tolist()
        kinds = [kind or list(SHARES)[number] for number in drawn]
        return Examples.joined([example for each_kind in kinds for example in self._group(each_kind, grey=grey)])

    def _group(self, kind: str, *, grey: bool) -> list[Examples]:
        """As many examples of a kind as there are parts of a photograph."""
        if kind == "camera":
            return [self.camera(grey=grey)]
        return [self.makers[kind](grey=grey) for _ in range(self.parts)]

    def white(self, *, grey: bool) -> Examples:
        """White noise: uniform, varying over the crop, or dependent on brightness."""
        draws, clean = self.draws, self.crops.crop(grey=grey)[None]
        level = LARGEST * draws.number() ** 1.4
        kind = draws.number()
        if kind < 0.82:
            deviation = torch.full_like(clean, level)
            if kind >= 0.7:
                shades = draws.uniform(1, 1, 3, 3)
                shades = F.interpolate(shades, clean.shape[-2:], mode="bilinear", align_corners=True)
                deviation = level * (0.3 + 1.4 * shades).expand_as(clean)
            noisy = clean + deviation * draws.normal(*clean.shape)
            told = deviation
        else:
            gain, floor = level**2 * draws.number(0.5, 2.0), (0.3 * level * draws.number()) ** 2
            noisy = clean + (gain * clean.clamp(min=0) + floor).sqrt() * draws.normal(*clean.shape)
            seen = F.avg_pool2d(F.pad(noisy, (2, 2, 2, 2), mode="reflect"), 5, 1)  # estimated brightness
            told = (gain * seen.clamp(min=0) + floor).sqrt()
        if not self.exact and draws.chance(MISSTATED):
            told = told * draws.factor(*RATIOS)
        levels = level_planes(told, clean)
        return Examples(clean, noisy.clamp(0, 1) if draws.chance(0.15) else noisy, levels)

    def camera(self, *, grey: bool) -> Examples:
        """Parts of a photograph by a random camera; the clean ones are the mean of many shots, as in sets of pairs."""
        draws, camera = self.draws, Camera.drawn(self.draws.generator)
        across = math.ceil(math.sqrt(self.parts))
        side = across * self.side + 2 * MARGIN
        crop = self.pictures.cut(draws, camera.side_before(side)).expand(3, -1, -1)
        clean, noisy = (picture[None] for picture in camera.photograph(crop, side, draws.generator))
        if grey:
            mixture = draws.uniform(1, 3, 1, 1) + 0.1
            clean, noisy = ((mixture / mixture.sum() * picture).sum(1, keepdim=True) for picture in (clean, noisy))
        profile = profile_of_difference(noisy, clean)
        if not self.exact:
            ratio = draws.factor(*RATIOS) if draws.chance(2 * MISSTATED) else 1.0
            uneven = (UNEVEN * draws.normal(1, len(profile.SCALES), 2, 1)).exp()
            profile = replace(profile, levels=ratio * uneven * profile.levels)
        return Examples(*(self._divided(planes) for planes in (clean, noisy, profile.at(noisy, SCALES))))

    def _divided(self, planes: Tensor) -> Tensor:
        """Divide planes (1, C, N, N) into the parts of a photograph, without its margin."""
        inner = planes[0, :, MARGIN:-MARGIN, MARGIN:-MARGIN]
        parts = inner.unfold(1, self.side, self.side).unfold(2, self.side, self.side)
        return parts.permute(1, 2, 0, 3, 4).flatten(0, 1)[: self.parts].contiguous()

    def unchanged(self, *, grey: bool) -> Examples:
        """A clean crop that is said to have faint noise, in 8 bits."""
        crop = (255 * self.crops.crop(grey=grey)[None]).round() / 255
        levels = level_planes(FAINTEST * self.draws.number() ** 2, crop)
        coarser = torch.cat([torch.full((1, 2, 1, 1), self.draws.number(0.7, 2.0) ** power) for power in range(3)], 1)
        return Examples(crop, crop, levels * coarser)
