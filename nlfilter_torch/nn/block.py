"""A non-local block of networks whose attention is the operator of its own embedding. Paper: Sec. II."""

from collections.abc import Collection
from math import prod
from types import MappingProxyType
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_choice, check_count, check_dtype, check_finite
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.nn.parameters import Learnable, check_learn, positive_option
from nlfilter_torch.operator.build import operator_from_points
from nlfilter_torch.operator.options import SAMPLING, FilterOptions, Sampling, check_options

Norm = Literal["batch", "none"]
BlockOption = Literal["temperature", "spatial_bandwidth"]
LEARNABLE: tuple[BlockOption, ...] = get_args(BlockOption)

LARGEST_EMBEDDING = 8  # default of embedding_channels: more of them need more landmarks
FLAT = 1e-10  # mean square of a centred embedding with values up to 1, below which it counts as constant
SMALLEST = 1e-6  # magnitude of an embedding below which it is not scaled up


class NonlocalBlock(Learnable):
    """Non-local block of a network, in place of the embedded Gaussian one, without the matrix of all pairs of pixels.

    The usual block computes ``x + norm(V softmax(Q^T K))`` with queries Q, keys K and values V from 1x1 convolutions.
    Here queries and keys are one embedding: the attention is the operator W of :func:`operator_from_features`, with
    affinities ``exp(-|e_i - e_j|^2)``, balanced so that rows and columns sum to 1, and ``x + norm(V W)`` takes time and
    memory in proportion to the number of pixels. Source: Wang, Girshick, Gupta and He, Non-local Neural Networks, 2018.

    The embedding of each image is centred and scaled to a mean square of ``temperature^2``, whatever the scale of the
    convolution before it, so that affinities neither vanish nor become all equal. The last layer starts at zero, so
    that a block that is inserted into a trained network does not change it.

    W is symmetric and doubly stochastic. The block thus cannot attend in one direction: queries that differ from keys,
    cross-attention, causal masks and a pixel that all others attend to are beyond it; and it computes in float32 inside
    autocast. With few landmarks W resolves few clusters of pixels.

    Args:
        channels: C of the input and the output.
        inner_channels: of the values; None means half of ``channels``.
        embedding_channels: D of the embedding; None means half of ``channels``, at most 8.
        num_landmarks: as for :func:`operator_from_features`; of a feature map with fewer pixels, all are landmarks.
        landmarks: ``"kmeans"``, ``"uniform"`` or ``"random"``.
        temperature: a positive number; the mean squared distance of two embeddings is twice its square. A larger one
            makes the attention more selective.
        spatial_bandwidth: a positive number of pixels (and frames), at which distance affinities fall to 1/e; None
            leaves out distances.
        norm: ``"batch"`` ends with a batch normalisation whose weight starts at zero, ``"none"`` with a convolution
            that starts at zero.
        learn: the options to learn: any of ``"temperature"`` and ``"spatial_bandwidth"`` (which needs an initial
            value); both stay positive.

    Raises:
        TypeError, ValueError: for an invalid argument; the message says what it must be and what it was.

    Example:
        >>> block = NonlocalBlock(16, num_landmarks=20)
        >>> block(torch.rand(2, 16, 24, 32)).shape
        torch.Size([2, 16, 24, 32])
        >>> clip, tokens = torch.rand(1, 16, 4, 12, 16), torch.rand(1, 16, 200)
        >>> block(clip).shape, block(tokens).shape
        (torch.Size([1, 16, 4, 12, 16]), torch.Size([1, 16, 200]))
    """

    learnable = MappingProxyType({"temperature": "log_temperature", "spatial_bandwidth": "log_spatial_bandwidth"})
    temperature: float | Tensor = positive_option("temperature", "Number; a tensor of shape () if it is learned.")
    spatial_bandwidth: float | Tensor | None = positive_option(
        "spatial_bandwidth", "Number of pixels or None; a tensor of shape () if it is learned."
    )

    def __init__(
        self,
        channels: int,
        *,
        inner_channels: int | None = None,
        embedding_channels: int | None = None,
        num_landmarks: int = 64,
        landmarks: Sampling = SAMPLING,
        temperature: float = 2.0,
        spatial_bandwidth: float | None = None,
        norm: Norm = "batch",
        learn: BlockOption | Collection[BlockOption] = LEARNABLE[:1],
    ) -> None:
        super().__init__()
        names = check_learn(learn, LEARNABLE)
        check_count(channels, "channels")
        inner = max(channels // 2, 1) if inner_channels is None else inner_channels
        embedding = min(max(channels // 2, 1), LARGEST_EMBEDDING) if embedding_channels is None else embedding_channels
        check_count(inner, "inner_channels")
        check_count(embedding, "embedding_channels")
        check_choice(landmarks, "landmarks", get_args(Sampling))
        check_options(FilterOptions(num_landmarks=num_landmarks, landmarks=landmarks))
        check_choice(norm, "norm", ("batch", "none"))
        if spatial_bandwidth is None and "spatial_bandwidth" in names:
            raise ValueError(
                "spatial_bandwidth must be a number of pixels if it is learned, got None; "
                "start with a third of the height of the feature map"
            )
        self.start_positive("temperature", temperature, names)
        self.start_positive("spatial_bandwidth", spatial_bandwidth, names, other=type(None))
        self.channels = channels
        self.num_landmarks = num_landmarks
        self.landmarks: Sampling = landmarks
        self.embedding = nn.Conv1d(channels, embedding, 1, bias=False)  # a bias would not change distances
        self.value = nn.Conv1d(channels, inner, 1)
        self.output = nn.Conv1d(inner, channels, 1)
        self.norm = nn.BatchNorm1d(channels) if norm == "batch" else nn.Identity()
        last = self.output if norm == "none" else self.norm
        for parameter in last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        """Add what similar pixels contribute to features.

        Args:
            x: (B, C, H, W), frames (B, C, T, H, W) or tokens (B, C, N), finite; pixels of all frames attend to one
                another.

        Returns:
            A tensor of the shape of ``x``. Differentiable once in ``x`` and all parameters, with the choice of
            landmarks held fixed.

        Raises:
            TypeError, ValueError: if ``x`` is not such a tensor, or has no coordinates for a ``spatial_bandwidth``.
        """
        self._check(x)
        size = x.shape[2:]
        points = x.flatten(2)
        features = self._features(self.embedding(points), size)
        options = FilterOptions(num_landmarks=min(self.num_landmarks, points.shape[2]), landmarks=self.landmarks)
        operator = operator_from_points(features, (prod(size[:-1]), size[-1]), options)
        values = self.value(points)
        attended = (operator @ values.unflatten(2, operator.size)).flatten(2)
        added: Tensor = self.norm(self.output(attended))
        return x + added.view(x.shape)

    def _features(self, embedding: Tensor, size: tuple[int, ...]) -> Tensor:
        """Features (B, D, N) of an embedding (B, D', N): standardised, with scaled coordinates if they count."""
        features = standardised(embedding) * self.temperature
        if self.spatial_bandwidth is None:
            return features
        places = coordinates(size, features) / self.spatial_bandwidth
        return torch.cat([features, places.expand(len(features), -1, -1)], dim=1)

    def _check(self, x: Tensor) -> None:
        """Raise unless ``x`` is a feature map of this block."""
        check_dtype(x, "x", "convert it with .float()")
        own = self.value.weight.dtype
        if x.dtype != own and not torch.is_autocast_enabled(x.device.type):
            raise TypeError(f"x must have the dtype of the block, {own}, got {x.dtype}; convert one of them with .to()")
        if x.ndim not in (3, 4, 5) or 0 in x.shape[1:]:
            raise ValueError(
                f"x must have shape (B, C, N), (B, C, H, W) or (B, C, T, H, W) with at least one pixel, got "
                f"{tuple(x.shape)}; add the missing dimensions"
            )
        if x.shape[1] != self.channels:
            raise ValueError(
                f"x must have {self.channels} channel(s), got {x.shape[1]}; construct the block with "
                f"channels={x.shape[1]}"
            )
        if x.ndim == 3 and self.spatial_bandwidth is not None:
            raise ValueError(
                f"x must have places (B, C, H, W) or (B, C, T, H, W) for a spatial_bandwidth, got {tuple(x.shape)}; "
                "pass spatial_bandwidth=None for tokens"
            )
        check_finite(x, "x")

    def extra_repr(self) -> str:
        """The options of the block."""
        return (
            f"{self.channels}, num_landmarks={self.num_landmarks}, landmarks={self.landmarks!r}, "
            f"temperature={self.shown('temperature')}, spatial_bandwidth={self.shown('spatial_bandwidth')}"
        )


@full_precision
def standardised(embedding: Tensor) -> Tensor:
    """Centre points (B, D, N) and scale them to a mean squared length of 1; points that are all equal become zero.

    In float32 at least. Invariant to scale: divided by the largest value first, no square overflows.
    """
    points = embedding.to(working_dtype(embedding))
    largest = points.detach().abs().amax((1, 2), keepdim=True) if points.numel() else points.new_ones(1)
    points = points / largest.clamp(min=SMALLEST)
    points = points - points.mean(2, keepdim=True)
    return points * (points.square().sum(1, keepdim=True).mean(2, keepdim=True) + FLAT).rsqrt()


def coordinates(size: tuple[int, ...], like: Tensor) -> Tensor:
    """Places (1, d, N) of the points of a grid with d dimensions, in the dtype and on the device of ``like``."""
    axes = [torch.arange(length, dtype=like.dtype, device=like.device) for length in size]
    return torch.stack(torch.meshgrid(axes, indexing="ij")).flatten(1).unsqueeze(0)
