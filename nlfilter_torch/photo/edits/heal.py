"""Small blemishes, replaced by similar patches of the same photograph."""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.kernels.stencil import solve_stencil
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import HEAL
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.pixels import M, Pixels
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Fitted, Source, at
from nlfilter_torch.photo.selections.by_hand import check_drawn
from nlfilter_torch.photo.selections.connected import connected_pieces

RING, MOST_RING = 4, 0.5  # pixels around a spot that are compared: at least so many, and this share of its radius
OFFSET = 0.75  # share of a difference in mean colour that does not count, since the membrane takes it away
NEARER = 0.02  # growth of the cost of a patch per radius of its distance
LARGEST_SPOT = 256  # pixels, of the sides of a spot


def heal(image: Tensor, spots: Tensor, *, reach: float = HEAL.defaults["reach"]) -> Tensor:
    """Replace spots by patches from around them.

    For each spot, the patch is the one within ``reach`` whose surroundings are most like those of the spot. It is added
    to a membrane that takes away its difference from the surroundings of the spot: the solution of Laplace's equation
    within it (Perez, Gangnet and Blake, "Poisson Image Editing", 2003). Where no patch fits, the membrane alone is
    left, without texture.

    Args:
        image: (B, C, H, W) in [0, 1].
        spots: (B, 1, H, W) in [0, 1], above 0 on the spots, each at most 256 pixels wide and high; what is 1 is
            replaced, less is mixed. Pixels marked in any image of a batch are used for none of them.
        reach: how far patches are searched, from 1 to 20 times the radius of the spot.

    Returns:
        (B, C, H, W), equal to the image outside the spots; values may leave [0, 1]. Differentiable in the image, and in
        ``spots`` where they are above 0; the choice of the patches counts as constant.

    Raises:
        TypeError, ValueError: if a tensor has another size or leaves its range, nothing is marked, or a spot is too
            large or has no pixels beside it.

    Example:
        >>> image = torch.linspace(0, 1, 40).expand(1, 1, 40, 40).clone()
        >>> spots = torch.zeros(1, 1, 40, 40)
        >>> spots[..., 18:22, 10:14] = 1
        >>> healed = heal(torch.where(spots > 0, 1.0, image), spots)
        >>> bool((healed - image).abs().max() < 1e-5)
        True
    """
    return edited(Heal, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Heal(PhotoEdit):
    """The edit of :func:`heal`."""

    declared: ClassVar[Edit] = HEAL
    relative: ClassVar[bool] = True
    reach: float

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the patches that replace the spots."""
        HEAL.check(reach=self.reach)
        check_drawn(drawn.masks.get("spots"), None, "spots")
        marked = source.scribbles(drawn.masks["spots"], None, "spots")
        places, healed = marked.places, torch.zeros_like(marked.image)
        pieces = torch.from_numpy(connected_pieces(places.cpu().numpy(), source.size[1])).to(places.device)
        spots = [Spot.of(places[pieces == piece], source.size, self.reach) for piece in pieces.unique()]
        known = torch.cat([spot.around for spot in spots]).unique()
        image, counted = at(source, known)
        usable = ~torch.isin(known, places)
        if counted is not None:
            usable &= (counted > 0).all(0)[0]
        for spot in spots:
            window = torch.searchsorted(known, spot.around)
            shape = spot.window
            own = spot.healed(image[:, :, window].unflatten(2, shape), usable[window].view(shape))
            healed[:, :, torch.searchsorted(places, spot.places)] = own
        weights = marked.weights
        return Fitted(Healed(Scribbles(places, torch.cat([weights, weights * healed], dim=1), marked.image)))


@dataclass(frozen=True, eq=False)
class Healed:
    """A picture with other pixels in its spots; scribbles have their weights, and then these pixels times weights."""

    spots: Scribbles

    def __call__(self, pixels: Pixels) -> Tensor:
        """The pixels."""
        weights, healed = self.spots.planes(pixels).tensor_split([1], dim=1)
        return pixels.image * (1 - weights) + healed


@dataclass(frozen=True, eq=False)
class Spot:
    """A spot of a picture.

    Attributes:
        places: row-major indices of its pixels.
        around: those of the window in which patches are searched.
        window: (h, w) of it.
        frame: rows and columns of the spot and its ring, in the window.
        radius: half of the longer side of the spot.
        ring: width of the ring.
    """

    places: Tensor
    around: Tensor
    window: tuple[int, int]
    frame: tuple[slice, slice]
    radius: float
    ring: int

    @staticmethod
    def of(places: Tensor, size: tuple[int, int], reach: float) -> "Spot":
        """The spot of the pixels at some places of a picture (H, W)."""
        ends = [(int(axis.min()), int(axis.max()) + 1) for axis in (places // size[1], places % size[1])]
        longest = max(last - first for first, last in ends)
        if longest > LARGEST_SPOT:
            raise ValueError(
                f"spots must be at most {LARGEST_SPOT} pixels wide and high, got {longest}; mark smaller ones"
            )
        ring = max(RING, round(MOST_RING * longest / 2))
        far = ring + max(1, round(reach * longest / 2))
        spans, frame = [], []
        for (first, last), length in zip(ends, size, strict=True):
            start, stop = max(first - ring, 0), min(last + ring, length)
            spans.append(torch.arange(max(start - far, 0), min(stop + far, length), device=places.device))
            frame.append(slice(start - int(spans[-1][0]), stop - int(spans[-1][0])))
        rows, columns = spans
        around = (rows[:, None] * size[1] + columns).flatten()
        return Spot(places, around, (len(rows), len(columns)), (frame[0], frame[1]), longest / 2, ring)

    def healed(self, image: Tensor, usable: Tensor) -> Tensor:
        """Its pixels (B, C, n), given an image (B, C, h, w) of the window, and which pixels of it are usable (h, w)."""
        marked = torch.isin(self.around, self.places).view(self.window)[self.frame]
        own, free = image[(..., *self.frame)], usable[self.frame]
        if not bool(free.any()):
            raise ValueError("spots must have visible pixels beside them, got one without; mark smaller ones")
        grown = F.max_pool2d(marked[None].float(), 2 * self.ring + 1, 1, self.ring)[0]
        patch = torch.stack([self._patch(one, usable, grown * free, marked) for one in image])
        unknown = ~free
        inner = F.pad(torch.ones_like(own[:1, :1]), (1, 1, 1, 1))
        stencil = own.new_zeros(1, 3, 3, *marked.shape)
        for row, column in ((0, 1), (1, 0), (1, 2), (2, 1)):
            height, width = marked.shape
            stencil[:, row, column] = -inner[:, 0, row : row + height, column : column + width] * unknown
        stencil[:, 1, 1] = torch.where(unknown, -stencil.sum((1, 2)), 1.0)
        membrane = solve_stencil(stencil.expand(len(own), -1, -1, -1, -1), torch.where(unknown, 0.0, own - patch))
        return (patch + membrane)[..., marked]

    def _patch(self, image: Tensor, usable: Tensor, ring: Tensor, marked: Tensor) -> Tensor:
        """The patch (C, h, w) whose ring is most like that of the spot; zeros if no patch has usable pixels only."""
        seen = torch.where(usable, image.detach(), 0.0).double()
        own, ring = seen[(..., *self.frame)], ring.double()
        hidden = _correlated((~usable).double(), ((ring + marked) > 0).double())
        squares = _correlated(seen.square(), ring) - 2 * _correlated(seen, ring * own)
        offset = (_correlated(seen, ring) - (ring * own).sum((1, 2), keepdim=True)).square() / ring.sum().clamp(min=1)
        cost = (squares + (ring * own.square()).sum((1, 2), keepdim=True) - OFFSET * offset).sum(0).clamp(min=0.0)
        rows, columns = (torch.arange(n, device=cost.device).double() for n in cost.shape)
        far = torch.hypot(rows[:, None] - self.frame[0].start, columns - self.frame[1].start) / self.radius
        cost = torch.where(hidden > 0.5, torch.inf, (cost + 1e-9) * (1 + NEARER * far))
        row, column = divmod(int(cost.argmin()), cost.shape[1])
        height, width = marked.shape
        found = bool(cost[row, column] < torch.inf)
        return image[:, row : row + height, column : column + width] * found


def _correlated(planes: Tensor, template: Tensor) -> Tensor:
    """Sums of products of planes (..., h, w) with a smaller template (..., a, b) at every place where it fits."""
    size = planes.shape[-2:]
    product = torch.fft.rfft2(planes) * torch.fft.rfft2(template, size).conj()
    rows, columns = (n - m + 1 for n, m in zip(size, template.shape[-2:], strict=True))
    return torch.fft.irfft2(product, size)[..., :rows, :columns]
