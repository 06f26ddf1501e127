"""Spots that someone painted, and how much every pixel correlates with each.

Under ``g = W + s W^2 + s^2 W^3 + ...``, s the reach, two pixels correlate by ``g_ij / sqrt(g_ii g_jj)``. A spot, which
is paint without a gap, is compared by the mean of what it covers, so that few odd pixels under a brush do not count.
"""

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.spectrum import Spectrum

MAX_SPOTS = 64  # of one region; further ones are taken together
TINY = 1e-6  # variance below which a pixel correlates with nothing


def spot_correlations(
    spectrum: Spectrum, regions: Tensor, reach: float | Tensor
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """For every image, correlations of its spots with all pixels and with each other, and whose they are.

    Args:
        spectrum: of the operator.
        regions: (B, K, H, W), weights above 0 where painted, in the spectrum's dtype; at least one spot in every image.
        reach: s in [0, 1), a number or a tensor of shape () or (B,).

    Yields:
        (J, N) and (J, J), within [-1, 1], and (J, K) of zeros and ones, the region of each of the J spots.
        Differentiable in operator, weights and reach.
    """
    factor = spectrum.factor  # (B, M, N)
    walk = torch.as_tensor(reach).to(spectrum.root).reshape(-1, 1)
    core = spectrum.gain(lambda eigenvalues: eigenvalues / (1 - walk * eigenvalues)).to(factor)
    image = core @ factor
    unit = (factor * image).sum(1, keepdim=True).clamp(min=TINY).rsqrt()  # (B, 1, N)
    for b, region in enumerate(regions):
        members, owners = _spots(region)  # (J, N), (J, K)
        means = members @ (factor[b] * unit[b]).mT  # (J, M)
        gram = means @ core[b] @ means.mT
        scale = gram.diagonal().clamp(min=TINY).rsqrt().unsqueeze(1)
        yield scale * (means @ image[b]) * unit[b], scale * gram * scale.mT, owners


def _spots(region: Tensor) -> tuple[Tensor, Tensor]:
    """Connected spots of regions (K, H, W): weights (J, N) of unit sum, and their regions (J, K)."""
    from skimage.measure import label  # slow to import

    members, owners = [], []
    for number, plane in enumerate(region):
        spots = torch.from_numpy(label((plane.detach() > 0).cpu().numpy(), connectivity=2)).to(plane.device)
        for spot in range(1, min(int(spots.max()), MAX_SPOTS) + 1):
            inside = plane * (spots >= spot if spot == MAX_SPOTS else spots == spot)
            members.append(inside.flatten() / inside.sum())
            owners.append(number)
    numbers = torch.tensor(owners, device=region.device)
    return torch.stack(members), F.one_hot(numbers, len(region)).to(region)
