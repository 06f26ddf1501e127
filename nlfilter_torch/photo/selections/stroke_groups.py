"""Groups of strokes for cross-validation: methods are compared by how well they predict a group from the others."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles, blocks_at, sums_in_blocks

GROUPS = 5
CELLS = 64  # number of cells along the short side; painted areas in the same or in adjacent cells are connected


@dataclass(frozen=True, eq=False)
class StrokeGroups:
    """The strokes of each image of a batch: its connected painted areas.

    Attributes:
        strokes: number of the stroke at each scribbled pixel, (B, n); any number where nothing is painted. Strokes with
            the same remainder after division by :data:`GROUPS` are a group.
        count: number S of strokes, the largest of all images.
    """

    strokes: Tensor
    count: int

    @staticmethod
    def of(scribbles: Scribbles, size: tuple[int, int]) -> "StrokeGroups":
        """Number the strokes of a picture (H, W). Areas closer together than 1/64 of the short side are connected."""
        from skimage.measure import label

        places, side = scribbles.places, max(1.0, min(size) / CELLS)
        cells = (math.ceil(size[0] / side), math.ceil(size[1] / side))
        weights = scribbles.weights.detach().amax(1, keepdim=True)
        painted = sums_in_blocks(weights, places, size[1], side, cells).squeeze(1) > 0
        numbers = torch.from_numpy(np.stack([label(image, connectivity=2) for image in painted.cpu().numpy()]))
        strokes = numbers.to(places).flatten(1)[:, blocks_at(places, size[1], side, cells)]
        return StrokeGroups((strokes - 1).clamp(min=0), int(numbers.max()))

    @property
    def groups(self) -> Tensor:
        """Number of the group at each scribbled pixel, (B, 1, n)."""
        return (self.strokes % GROUPS).unsqueeze(1)

    def without_each(self, weighted: Tensor) -> list[Tensor]:
        """Values (B, C, n) with those of one group replaced by 0, for each group; an empty list for single strokes."""
        if self.count < 2:
            return []
        return [weighted * (self.groups != number) for number in range(min(GROUPS, self.count))]

    def weights_without_each(self, weights: Tensor) -> list[Tensor]:
        """:meth:`without_each` of weights (B, 1, n), but images that would be left without any keep all of them."""
        sets = self.without_each(weights)
        return [torch.where(left.sum(2, keepdim=True) > 0, left, weights) for left in sets]

    def of_own(self, values: Sequence[Tensor]) -> Tensor:
        """Select, at each pixel, the values (B, C, n) that belong to its own group from those for every group."""
        return torch.stack(list(values)).gather(0, self.groups.expand(1, *values[0].shape)).squeeze(0)

    def sums(self, values: Tensor) -> Tensor:
        """Sums (B, C, S) of values (B, C, n) over each stroke, in float64."""
        sums = values.new_zeros(*values.shape[:2], self.count, dtype=torch.float64)
        return sums.scatter_add(2, self.strokes.unsqueeze(1).expand(values.shape), values.double())
