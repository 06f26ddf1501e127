"""The object that strokes mean: its colours, its place in the picture, and a cut between it and its background.

Each side has a mixture of Gaussians of colour, surrounding colour and texture. The ratio of their likelihoods, a
regression that knows what is similar, and distances to the strokes along the picture are the odds of each pixel. The
cut is the convex relaxation of a graph cut (Chan, Esedoglu and Nikolova, 2006), with the entropy H of the mask: it
maximises ``sum_i c_i u_i - sum_ij w_ij |u_i - u_j| + H(u)`` over masks u in [0, 1], with log odds c, and weights w of
neighbours that fall with their contrast. Its dual is smooth, so that accelerated projected gradients solve it (Beck and
Teboulle, 2009). In a few damped rounds the mixtures are fitted to the cut and the strokes again, as in GrabCut (Rother,
Kolmogorov and Blake, 2004). Where one object is meant, a small network
(:mod:`nlfilter_torch.photo.selections.object_network`) then corrects the odds of a last cut.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.kernels.stencil import solve_stencil
from nlfilter_torch.photo.picture.colour import hundredths_of_lab
from nlfilter_torch.photo.picture.resizing import block_means, enlarged
from nlfilter_torch.photo.selections.connected import Extent, unconnected
from nlfilter_torch.photo.selections.object_network import corrected
from nlfilter_torch.photo.selections.scribbled_colours import trimap_share

CUT_PIXELS, DISTANCE_PIXELS = 1 << 15, 1 << 13  # of the reduced pictures in which the cut and distances are computed
PARTS = (6, 8)  # Gaussians of the object and of its background, which is more varied
FLOOR = 4e-4  # added to variances: colours of an even area still differ by 2 units of Lab
EM_STEPS = 2  # from the parts that are split along principal axes, which are close
ROUNDS, DAMPING = 3, 0.7  # of fits to the cut, and share of a mask that each replaces
STROKES = 0.3  # weight of strokes in these fits, relative to all that is cut off
CERTAIN = 30.0  # log odds of strokes: above the sum of all others
RARE_COLOURS = -24.0  # log of how many pixels neither side explains, which the Gaussian of all colours does
MOST_BY_COLOUR = 6.0  # largest log odds by colour: neighbours and strokes overrule colours that a few pixels tell
LEAST_REGRESSION = 0.1  # of it and of 1 minus it, where its log odds end
BEYOND, FARTHEST = 0.5, 4.0  # log odds that are lost per radius of all strokes on an object, and for how many radii
CONTOUR = 8.0  # log odds that a border costs per pixel of its length in an even area
RARE, EPSILON = 1e-3, 1e-9  # relative weight of points that cost time and hardly count; least sum that is divided by
FRAME = 0.3  # weight of pixels along the borders of a picture that are unlike the object, relative to strokes
ACROSS, PER_CONTRAST = 4.0, 0.1  # distances along the picture: of an even one, and of a step of mean contrast
LEAST_CONTRAST, LEAST_RADIUS = 1e-3, 0.04  # mean contrast in hundredths of Lab; radius, relative to the picture's side
ANCHOR, SHARES = 1e6, (1e-30, 1 - 1e-6)  # weight of a side in random walks; limits of shares, whose logarithm is taken
STEPS = (25, 50)  # of the cut in each round, from the dual before, and in the last one

OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (row, column) offsets to half of the neighbours: each pair occurs once
LENGTHS = tuple(math.hypot(*offset) for offset in OFFSETS)


class Mixture(NamedTuple):
    """Gaussians, in float64: weights (K,), means (K, d) and covariances (K, d, d)."""

    weights: Tensor
    means: Tensor
    covariances: Tensor


@dataclass(frozen=True, eq=False)
class Points:
    """Points with products of their coordinates, of which sums of moments and log densities are linear functions.

    Attributes:
        places: (d, n), relative to their mean, which keeps rounding errors of the products small.
        products: 1, the coordinates and the products of pairs of them, (1 + d + d (d + 1) / 2, n).
    """

    places: Tensor
    products: Tensor

    @staticmethod
    def of(places: Tensor) -> "Points":
        """Points with coordinates (d, n)."""
        places = places - places.mean(1, keepdim=True)
        first, second = torch.triu_indices(len(places), len(places), device=places.device)
        return Points(places, torch.cat([torch.ones_like(places[:1]), places, places[first] * places[second]]))

    def mixture(self, weights: Tensor, parts: int) -> Mixture:
        """Fit a mixture to points with weights (n,), from parts that are split along principal axes."""
        counted = weights.detach() > RARE * weights.detach().max()
        own, weights = Points(self.places[:, counted], self.products[:, counted]), weights[counted]
        mixture = own.moments(own.split(weights.detach(), parts).to(weights) * weights)
        for _ in range(EM_STEPS):
            mixture = own.moments(own.log_densities(mixture).softmax(0) * weights)
        return mixture

    def moments(self, shares: Tensor) -> Mixture:
        """The mixture whose parts have shares (K, n) of the points."""
        count = len(self.places)
        sums = (shares @ self.products.mT).double()
        total = sums[:, :1].clamp(min=EPSILON)
        means, products = (sums[:, 1:] / total).tensor_split([count], dim=1)
        first, second = torch.triu_indices(count, count, device=sums.device)
        upper = products.new_zeros(len(shares), count, count)
        upper[:, first, second] = products
        squares = upper + upper.triu(1).mT - means.unsqueeze(1) * means.unsqueeze(2)
        return Mixture((total / total.sum()).squeeze(1), means, squares + FLOOR * torch.eye(count).to(squares))

    def log_densities(self, mixture: Mixture) -> Tensor:
        """Log densities (K, n) of the points in the parts of a mixture, without those constants that all share."""
        first, second = torch.triu_indices(len(self.places), len(self.places), device=self.places.device)
        precision = torch.linalg.inv(mixture.covariances)
        slopes = (precision @ mixture.means.unsqueeze(2)).squeeze(2)
        squares = precision[:, first, second] * torch.where(first == second, -0.5, -1.0)
        constant = mixture.weights.clamp(min=EPSILON).log() - (mixture.means * slopes).sum(1) / 2
        constant = constant - torch.linalg.slogdet(mixture.covariances)[1] / 2
        return torch.cat([constant.unsqueeze(1), slopes, squares], dim=1).to(self.products) @ self.products

    @torch.no_grad()
    def split(self, weights: Tensor, parts: int) -> Tensor:
        """Which part each point belongs to, (K, n) of bool: the part that spreads most is split, again and again.

        It is split at its mean, across its longest axis (Orchard and Bouman, 1991). No random choice is made, and
        turned pictures have the same parts.
        """
        labels = torch.ones_like(weights[None], dtype=torch.bool)
        mixture = self.moments(labels * weights)
        while len(labels) < parts:
            longest, axes = (values[..., -1] for values in torch.linalg.eigh(mixture.covariances))
            k = int((longest * mixture.weights).argmax())
            beyond = axes[k].to(self.places) @ self.places > (axes[k] @ mixture.means[k]).to(self.places)
            halves = torch.stack([labels[k] & beyond, labels[k] & ~beyond])
            if longest[k] < 2 * FLOOR or not bool(halves.any(1).all()):
                break
            of_halves = self.moments(halves * weights)
            of_halves = of_halves._replace(weights=of_halves.weights * mixture.weights[k])
            labels = torch.cat([labels[:k], halves, labels[k + 1 :]])
            pairs = zip(mixture, of_halves, strict=True)
            mixture = Mixture(*(torch.cat([all_of[:k], halved, all_of[k + 1 :]]) for all_of, halved in pairs))
        return labels


def beside(padded: Tensor, offset: tuple[int, int]) -> Tensor:
    """Planes (..., h, w) of the neighbours at an offset, of planes that are padded by a pixel on every side."""
    down, right = offset
    return padded[..., 1 + down : padded.shape[-2] - 1 + down, 1 + right : padded.shape[-1] - 1 + right]


def differences(planes: Tensor) -> Tensor:
    """Differences (4, C, h, w) of planes from their neighbours at :data:`OFFSETS`; without meaning at the border."""
    padded = F.pad(planes, (1, 1, 1, 1), mode="replicate")
    return torch.stack([planes - beside(padded, offset) for offset in OFFSETS])


def neighbours(planes: Tensor) -> Tensor:
    """Which pixels of planes (C, h, w) have a neighbour at :data:`OFFSETS`, (4, h, w): 1 or 0."""
    padded = F.pad(torch.ones_like(planes[0]), (1, 1, 1, 1))
    return torch.stack([beside(padded, offset) for offset in OFFSETS])


def from_before(planes: Tensor) -> list[Tensor]:
    """For planes (4, h, w) at :data:`OFFSETS`, those of the neighbours on the other side; 0 beyond the picture."""
    padded = F.pad(planes, (1, 1, 1, 1)).unbind(0)
    return [beside(plane, (-down, -right)) for plane, (down, right) in zip(padded, OFFSETS, strict=True)]


def cut(odds: Tensor, weights: Tensor, flow: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """The mask (h, w) of the cut, and the dual.

    Given flows p_ij between neighbours, at most w_ij either way, the mask is ``sigmoid(c_i - sum_j p_ij)``. The dual
    function's gradient, the difference of the masks of neighbours, has a Lipschitz constant of at most 4: the squared
    norm of all differences, 16, times the largest slope of the sigmoid, 1/4.

    Args:
        odds: c, (h, w).
        weights: w of the neighbours at :data:`OFFSETS`, (4, h, w).
        flow: p to start from, (4, h, w).
        steps: their number.
    """
    ahead, momentum = flow, 1.0
    for _ in range(steps):
        stepped = ahead + differences(_mask(odds, ahead).unsqueeze(0)).squeeze(1) / 4
        stepped = torch.maximum(torch.minimum(stepped, weights), -weights)
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        ahead = torch.lerp(flow, stepped, 1 + (momentum - 1) / following)
        flow, momentum = stepped, following
    return _mask(odds, flow), flow


def _mask(odds: Tensor, flow: Tensor) -> Tensor:
    """The mask of a dual: what flows in from the pixels before, and out to those after, changes the odds."""
    total = odds - flow.sum(0)
    for part in from_before(flow):
        total = total + part
    return total.sigmoid()


def nearness(lab: Tensor, sides: Tensor) -> Tensor:
    """How much nearer pixels are to the first of two sides (2, h, w): (D2 - D1) / (D2 + D1), (h, w) in [-1, 1].

    The distances along the picture, in which steps of colour are long, are those of random walks that end at each pixel
    with some probability: minus the logarithm of the share of those that begin there and reach a side before the other
    (Varadhan's formula). They are differentiable, and regard all paths.
    """
    size = (lab.shape[-2], lab.shape[-1])
    coarse = block_means(torch.cat([lab, sides]).unsqueeze(0), max(1.0, math.sqrt(lab[0].numel() / DISTANCE_PIXELS)))
    lab, anchors = coarse.squeeze(0).double().split([len(lab), 2])
    shape, there = (lab.shape[-2], lab.shape[-1]), neighbours(lab)
    contrast = (differences(lab).square().sum(1) + EPSILON**2).sqrt() * there
    mean = (contrast.sum() / there.sum().clamp(min=1.0)).clamp(min=LEAST_CONTRAST)
    lengths = lab.new_tensor(LENGTHS).view(-1, 1, 1) * (ACROSS / max(shape) + PER_CONTRAST * contrast / mean)
    links = there / lengths.square()
    anchors = ANCHOR * anchors
    own = 1 + anchors.sum(0)
    coefficients: dict[tuple[int, int], Tensor] = {}
    for (down, right), link, before in zip(OFFSETS, links, from_before(links), strict=True):
        coefficients[down, right], coefficients[-down, -right] = -link, -before
        own = own + link + before
    coefficients[0, 0] = own
    stencil = torch.stack([coefficients[down, right] for down in (-1, 0, 1) for right in (-1, 0, 1)])
    shares = solve_stencil(stencil.unflatten(0, (3, 3)).unsqueeze(0), anchors.unsqueeze(0)).squeeze(0)
    first, second = -shares.clamp(*SHARES).log()
    ratio = ((second - first) / (second + first)).to(sides)[None, None]
    return enlarged(ratio, (size[0] / shape[0], size[1] / shape[1]), (0, 0), size)[0, 0]


@torch.no_grad()
def radii_beyond(strokes: Tensor) -> Tensor:
    """Distance (h, w) of pixels from strokes (h, w), in units of the root mean square distance of these from theirs."""
    from scipy.ndimage import distance_transform_edt

    rows, columns = (torch.arange(length, device=strokes.device).to(strokes) for length in strokes.shape)
    spread = strokes.new_zeros(())
    for places, sums in ((rows, strokes.sum(1)), (columns, strokes.sum(0))):
        share = sums / sums.sum()
        spread = spread + (share * (places - (share * places).sum()).square()).sum()
    away = torch.from_numpy(distance_transform_edt((strokes <= 0).cpu().numpy())).to(strokes)
    return (away / spread.sqrt().clamp(min=LEAST_RADIUS * math.sqrt(strokes.numel()))).clamp(max=FARTHEST)


def object_masks(
    image: Tensor,
    guide: Tensor,
    likely: Tensor,
    sides: Tensor,
    drawn: Tensor,
    boxed: Tensor | None,
    extent: Extent,
) -> Tensor:
    """Masks (B, 1, H, W) of the object in each image.

    Args:
        image: (B, C, H, W).
        guide: what colours and textures are compared by, (B, D, H, W).
        likely: a regression, about 1 inside and about 0 outside, (B, 1, H, W).
        sides: weights of what is known of the object and of its background, (B, 2, H, W).
        drawn: those of strokes alone, likewise: all else may turn out to be wrong.
        boxed: whether a pixel may belong to the object, (B, 1, H, W), or None.
        extent: that of :func:`region_mask`.
    """
    size = (image.shape[-2], image.shape[-1])
    lab = hundredths_of_lab(image)
    free = torch.ones_like(likely) if boxed is None else boxed.to(likely)
    step = max(1.0, math.sqrt(size[0] * size[1] / CUT_PIXELS))
    # In float64: in float32, the sums of turned pictures would differ by rounding.
    planes = block_means(torch.cat([lab, guide, likely.clamp(0.0, 1.0), sides, drawn, free], dim=1), step).double()
    counts = [lab.shape[1], guide.shape[1], 1, 2, 2, 1]
    parts = [[plane.squeeze(0) for plane in own.split(counts, dim=1)] for own in planes.split(1)]
    trimaps = trimap_share(drawn.flatten(2))
    masks = [_object_mask(own, extent, trimap) for own, trimap in zip(parts, trimaps, strict=True)]
    steps = (size[0] / planes.shape[-2], size[1] / planes.shape[-1])
    return enlarged(torch.stack(masks).unsqueeze(1), steps, (0, 0), size).to(likely) * free


def _object_mask(planes: list[Tensor], extent: Extent, trimap: Tensor) -> Tensor:
    """:func:`object_masks` (h, w) of one image.

    Args:
        planes: Lab, guide, regression, sides, strokes, and whether a pixel is free to belong to the object, (C, h, w).
        extent: that of :func:`region_mask`.
        trimap: :func:`trimap_share`.
    """
    lab, guide, likely, sides, drawn, free = planes
    shape, without_box, strokes = (lab.shape[-2], lab.shape[-1]), bool((free == 1).all()), drawn[0]
    is_object = extent == "object" and bool((strokes > 0).any())
    there = neighbours(lab)
    squared = differences(lab).square().sum(1) * there
    typical = 2 * squared.sum() / there.sum().clamp(min=1.0) + EPSILON
    weights = CONTOUR * there * torch.exp(-squared / typical) / lab.new_tensor(LENGTHS).view(-1, 1, 1)
    likely, unlike = likely.squeeze(0), (1 - likely.squeeze(0)).square()
    beyond = torch.maximum(sides[1], (1 - free.squeeze(0)) * (strokes == 0))
    told = CERTAIN * (strokes - beyond)
    odds = told + likely.logit(LEAST_REGRESSION)
    if without_box:
        frame = torch.ones_like(unlike)
        frame[1:-1, 1:-1] = 0.0
        beyond = torch.maximum(beyond, FRAME * frame * unlike * (sides[0] == 0))
    near, away = torch.zeros_like(odds), torch.zeros_like(odds)
    if extent != "everywhere":
        near = nearness(lab, torch.stack([sides[0], beyond]))
        odds = odds + near
    if extent == "object" and bool((sides[0] > 0).any()):
        away = radii_beyond(sides[0])
        odds = odds - BEYOND * away * without_box
    points = Points.of(guide.flatten(1))
    rare = points.log_densities(points.moments(torch.ones_like(points.places[:1]))).squeeze(0) + RARE_COLOURS
    known = [sides[0].flatten(), beyond.flatten() if bool((beyond > 0).any()) else unlike.flatten() + EPSILON]
    fitted, flow, mask = known, torch.zeros_like(weights), torch.zeros_like(odds)
    ratios = list[Tensor]()
    for number in range(ROUNDS + 1):
        inside, outside = (
            points.log_densities(points.mixture(side, count)).logsumexp(0).logaddexp(rare)
            for side, count in zip(fitted, PARTS, strict=True)
        )
        ratios.append((inside - outside).view(shape))
        by_colour = ratios[-1].clamp(-MOST_BY_COLOUR, MOST_BY_COLOUR)
        solved, flow = cut(odds + by_colour, weights, flow, STEPS[number // ROUNDS])
        mask = torch.lerp(mask, solved, DAMPING if number else 1.0)
        if is_object:
            mask = mask * ~unconnected(mask, strokes)
        cut_off = [(2 * side.flatten() - 1).clamp(min=0.0) for side in (mask, 1 - mask)]
        fitted = [part + STROKES * side * (part.sum() / side.sum()) for part, side in zip(cut_off, known, strict=True)]
    by_trimap = (odds + by_colour).sigmoid()
    if is_object:
        density = (inside.maximum(outside) - rare).view(shape)
        known = [ratios[0], ratios[-1], density, likely, near, away, *sides, *drawn, free.squeeze(0), mask]
        evidence = torch.cat([lab, guide[-3:], torch.stack(known)])
        mask, _ = cut(corrected(evidence) + told, weights, torch.zeros_like(flow), STEPS[1])
        mask = mask * ~unconnected(mask, strokes)
    return torch.lerp(mask, by_trimap, trimap)
