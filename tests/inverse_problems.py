"""Random linear problems of restoration, small enough for dense matrices that tell the truth."""

import math
from dataclasses import dataclass
from functools import cached_property

import skimage.data
import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch import Contraction, NonlocalPrior, nonlocal_operator
from nlfilter_torch.filtering.contraction import Map
from nlfilter_torch.filtering.prior import Form
from tests.problems import seeded

SIDE = 12
KINDS = ("blur", "inpainting", "subsampling")
ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-9}


@dataclass(frozen=True)
class Truth:
    """Dense eigenvalues: of a step in magnitude, and of A^T A."""

    factor: float
    squared_norm: float


@dataclass(frozen=True)
class Problem:
    """An image, what is measured of it, and a prior of it."""

    kind: str
    image: Tensor
    forward: Map
    transpose: Map
    prior: NonlocalPrior
    strength: float
    share: float | None  # of the longest step, 2 / |A|^2; None takes the default

    @property
    def rounding(self) -> float:
        """Of eigenvalues; those of W are multiplied by g in the prior."""
        g = self.strength * float(self.promised.step)
        return ROUNDING[self.image.dtype] * (1 + g / 50)

    def truth(self) -> Truth:
        unit = torch.eye(SIDE**2, dtype=torch.float64)
        basis = unit.to(self.image).view(-1, 1, SIDE, SIDE)
        normal = self.transpose(self.forward(basis)).double().view(unit.shape)
        w = self.prior.operator.to_dense()[0].double()
        step = float(self.promised.step)
        g = step * self.strength
        if self.prior.form == "red":
            proximal = torch.linalg.inv(unit + g * (unit - w))
        else:
            proximal = w @ torch.linalg.inv((1 - g) * w + g * unit)
        factor = float(torch.linalg.eigvals(proximal @ (unit - step * normal)).abs().max())
        return Truth(factor, float(torch.linalg.eigvalsh(normal)[-1]))

    @cached_property
    def promised(self) -> Contraction:
        found = self.prior.contraction(self.forward, self.transpose, strength=self.strength)
        if self.share is None:
            return found
        step = 2 * self.share * float(found.step)
        return self.prior.contraction(self.forward, self.transpose, strength=self.strength, step=step)

    def measured_factors(self, steps: int) -> list[float]:
        """By how much each step contracts the change of the step before, in the norm of the promise."""
        step = float(self.promised.step)
        plain = torch.randn(self.image.shape, generator=seeded(1), dtype=torch.float64).to(self.image)
        factors, before = list[float](), 0.0
        for number in range(steps):
            change = self.prior.prox(plain, step * self.strength)  # P z, of the norm z^T P z
            length = math.sqrt(max(float((plain.double() * change.double()).sum()), 0.0))
            if number and length > 1e-3 * before:  # not lost in rounding
                factors.append(length / before)
            before = length
            plain = change - step * self.transpose(self.forward(change))
        return factors


def random_problem(seed: int) -> Problem:
    """A crop of a photograph, a linear A and a prior, by chance; half of them in float32."""
    generator = seeded(seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=generator))

    dtype, kind = (torch.float32, torch.float64)[seed % 2], KINDS[seed % 3]
    picture = (skimage.data.camera(), skimage.data.coins(), skimage.data.moon())[int(uniform(0, 3))]
    top, left = (int(uniform(0, side - 2 * SIDE)) for side in picture.shape)
    crop = picture[top : top + 2 * SIDE : 2, left : left + 2 * SIDE : 2]
    image = torch.from_numpy(crop.copy()).to(dtype)[None, None] / 255
    forward, transpose = _maps(kind, uniform(0.5, 2.0), uniform(0.1, 0.9), dtype, generator)
    form: Form = ("red", "plug-and-play")[seed // 3 % 2]  # type: ignore[assignment]
    operator = nonlocal_operator(image, num_landmarks=20, photometric_bandwidth=10 ** uniform(-2.3, -0.3))
    return Problem(
        kind,
        image,
        forward,
        transpose,
        NonlocalPrior(operator, form),
        strength=10 ** uniform(-2, 2),
        share=uniform(0.1, 0.98) if seed % 4 else None,
    )


def _maps(kind: str, width: float, share: float, dtype: torch.dtype, generator: torch.Generator) -> tuple[Map, Map]:
    if kind == "blur":
        profile = torch.exp(-torch.arange(-3.0, 4.0).square() / (2 * width**2))
        profile = profile / profile.sum()
        kernel = (profile[:, None] * profile).to(dtype)[None, None]
        return lambda x: F.conv2d(x, kernel, padding=3), lambda y: F.conv_transpose2d(y, kernel, padding=3)
    if kind == "inpainting":
        known = (torch.rand(1, 1, SIDE, SIDE, generator=generator) < share).to(dtype)
        return lambda x: known * x, lambda y: known * y
    return lambda x: F.avg_pool2d(x, 2), lambda y: F.interpolate(y, scale_factor=2) / 4
