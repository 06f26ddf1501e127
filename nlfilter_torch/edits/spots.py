"""Spots that someone painted, and how much every pixel correlates with each.

Under ``g = W + s W^2 + s^2 W^3 + ...``, s the reach, two pixels correlate by ``g_ij / sqrt(g_ii g_jj)``. A spot, which
is paint without a gap, is compared by the mean of what it covers, so that few odd pixels under a brush do not count.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.spectrum import Spectrum

MAX_SPOTS = 64  # of one region; further ones are taken together
TINY = 1e-6  # variance below which a pixel correlates with nothing


@dataclass(frozen=True, eq=False)
class Spots:
    """The J spots of one image, and what it takes to compare all its pixels with them.

    Attributes:
        between: correlations of the spots with each other, (J, J), within [-1, 1].
        owners: the region that each spot belongs to, (J, K) of zeros and ones.
        means: of the spots' factor columns, scaled to unit variance, (J, M).
        columns: of all pixels, likewise, multiplied by the core, (M, N).
    """

    between: Tensor
    owners: Tensor
    means: Tensor
    columns: Tensor

    def mix(self, weights: Tensor) -> Tensor:
        """Weighted sums (L, N), with weights (L, J), of the correlations of every pixel with the spots."""
        return (weights @ self.means) @ self.columns


def find_spots(spectrum: Spectrum, regions: Tensor, reach: float | Tensor) -> Iterator[Spots]:
    """The spots of every image.

    Args:
        spectrum: of the operator.
        regions: (B, K, H, W), weights above 0 where painted, in the spectrum's dtype; at least one spot in every image.
        reach: s in [0, 1), a number or a tensor of shape () or (B,).

    Yields:
        The spots of an image after the other. Differentiable in operator, weights and reach.
    """
    factor = spectrum.factor  # (B, M, N)
    walk = torch.as_tensor(reach).to(spectrum.root).reshape(-1, 1)
    core = spectrum.gain(lambda eigenvalues: eigenvalues / (1 - walk * eigenvalues)).to(factor)
    columns = core @ factor
    unit = (factor * columns).sum(1, keepdim=True).clamp(min=TINY).rsqrt()  # (B, 1, N)
    for b, region in enumerate(regions):
        means, owners = _means(region, factor[b] * unit[b])  # (J, M), (J, K)
        gram = means @ core[b] @ means.mT
        scale = gram.diagonal().clamp(min=TINY).rsqrt().unsqueeze(1)
        yield Spots(scale * gram * scale.mT, owners, scale * means, columns[b] * unit[b])


def _means(region: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted means (J, M) of vectors (M, N) over the connected spots of regions (K, H, W); their regions (J, K)."""
    from skimage.measure import label  # slow to import

    means, owners = [], []
    for number, plane in enumerate(region):
        spots = torch.from_numpy(label((plane.detach() > 0).cpu().numpy(), connectivity=2)).to(plane.device).flatten()
        inside = spots.nonzero().squeeze(1)
        if len(inside) == 0:
            continue
        spot = spots[inside].clamp(max=MAX_SPOTS) - 1
        weights, count = plane.flatten()[inside], int(spot.max()) + 1
        total = weights.new_zeros(count).index_add(0, spot, weights)
        sums = weights.new_zeros(count, vectors.shape[0]).index_add(0, spot, (vectors[:, inside] * weights).mT)
        means.append(sums / total.unsqueeze(1))
        owners += [number] * count
    return torch.cat(means), F.one_hot(torch.tensor(owners, device=region.device), len(region)).to(region)
