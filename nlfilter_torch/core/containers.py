"""Dataclasses of tensors, such as operators and spectra, as values: indexing, joining, moving and loading from files.

The first dimension of their tensors numbers the images of a batch; a tensor with a batch of 1 serves for all images.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_hidden

Target = torch.device | str | int | torch.dtype | Tensor
Index = int | slice | Sequence[int] | Sequence[bool] | Tensor
Container = TypeVar("Container")
Path = frozenset[str]

# Fields that are sums over all pixels, kept in float64 whatever the precision of the pixels.
EXACT = frozenset({"moment", "moments", "captured", "before", "ritz", "root"})
# Fields whose tensors have no dimension of images.
SHARED = frozenset({"patch_weights"})
# Numbers that are measured over all images of a batch; joined batches keep the largest.
MEASURED = frozenset({"residual", "balancing_steps"})
# Numbers that may differ between batches; joined, they become tensors with one entry per image.
BANDWIDTHS = frozenset({"photometric_bandwidth", "spatial_bandwidth"})


class Batch:
    """Base of dataclasses of tensors with one entry per image: values that are indexed, joined, detached and moved."""

    factor: Tensor

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.factor.device

    @property
    def dtype(self) -> torch.dtype:
        """float32 or float64."""
        return self.factor.dtype

    def __len__(self) -> int:
        """Number of images."""
        return len(self.factor)

    def __iter__(self) -> Iterator[Self]:
        return (self[image] for image in range(len(self)))

    def __getitem__(self, index: Index) -> Self:
        """Select images: an int selects one and keeps the batch dimension, a slice, a list or a tensor any of them."""
        chosen = _chosen(index, len(self), self.device)
        return map_tensors(self, partial(_select, chosen, len(self)))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy all tensors; those of a graph, which torch does not copy deeply, are cloned in it."""
        copies: dict[int, Tensor] = {}  # tensors that are shared stay so

        def copied(tensor: Tensor, _: Path) -> Tensor:
            if id(tensor) not in copies:
                copies[id(tensor)] = deepcopy(tensor, memo) if tensor.is_leaf else tensor.clone()
            return copies[id(tensor)]

        return map_tensors(self, copied)

    @classmethod
    def cat(cls, batches: Sequence[Self]) -> Self:
        """Join batches, in their order, to one batch of all their images.

        Args:
            batches: at least one; equal in size, number of landmarks, options, dtype and device. Bandwidths may differ.

        Returns:
            The joint batch, differentiable in all of them.

        Raises:
            TypeError, ValueError: if they are not such a list, or differ; the message says in what.
        """
        check_batches(batches, cls)
        return joined(cls.alike(batches), [len(batch) for batch in batches])

    @classmethod
    def alike(cls, batches: Sequence[Self]) -> Sequence[Self]:
        """The batches, with the same fields that are not None."""
        return batches

    def detach(self) -> Self:
        """Return the same values without gradients, in the same memory."""
        return map_tensors(self, lambda tensor, _: tensor.detach())

    def to(self, target: Target, dtype: torch.dtype | None = None) -> Self:
        """Move all tensors to another device, or convert them to another precision.

        Args:
            target: a device, a dtype (float32 or float64), or a tensor that has both.
            dtype: the dtype, if ``target`` is a device.

        Raises:
            TypeError: if the dtype is neither float32 nor float64.
        """
        return moved(self, target, dtype)


def loadable(*classes: type) -> None:
    """Let ``torch.load(..., weights_only=True)`` load these classes: they hold tensors, numbers and one another."""
    torch.serialization.add_safe_globals(list(classes))


def moved(container: Container, target: Target, dtype: torch.dtype | None = None) -> Container:
    """Copy a dataclass with all its tensors moved to another device or converted to another precision.

    Raises:
        TypeError: if the dtype is neither float32 nor float64.
    """
    device: torch.device | None = None
    if isinstance(target, Tensor):
        device, dtype = target.device, target.dtype
    elif isinstance(target, torch.dtype):
        dtype = target
    else:
        device = torch.device(target)
    if dtype not in (None, torch.float32, torch.float64):
        raise TypeError(
            f"dtype must be torch.float32 or torch.float64, got {dtype}; filters convert images of other dtypes"
        )
    return map_tensors(container, partial(_move, device, dtype))


def _move(device: torch.device | None, dtype: torch.dtype | None, tensor: Tensor, path: Path) -> Tensor:
    kept = dtype is None or not tensor.is_floating_point() or bool(path & EXACT)
    return tensor.to(device=device, dtype=tensor.dtype if kept else dtype)


def map_tensors(container: Container, function: Callable[[Tensor, Path], Tensor]) -> Container:
    """Copy a dataclass with all its tensors, also those of dataclasses and tuples in it, replaced by a function.

    The function takes a tensor and the names of the fields that lead to it.
    """
    if torch.is_inference_mode_enabled():  # the copies are ordinary tensors, which later training may use
        with torch.inference_mode(False), torch.no_grad():
            return map_tensors(container, function)
    result: Container = _mapped(container, function, frozenset())
    return result


def _mapped(value: Any, function: Callable[[Tensor, Path], Tensor], path: Path) -> Any:
    """:func:`map_tensors` for a value of any type."""
    if isinstance(value, Tensor):
        return function(value, path)
    if isinstance(value, tuple):
        return tuple(_mapped(item, function, path) for item in value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    entries = {
        field.name: _mapped(getattr(value, field.name), function, path | {field.name}) for field in fields(value)
    }
    return replace(value, **entries)


def _chosen(index: object, images: int, device: torch.device) -> slice | Tensor:
    """What selects the images of an index from the first dimension of a tensor."""
    if isinstance(index, Sequence) and not isinstance(index, str) and all(isinstance(entry, int) for entry in index):
        index = torch.tensor(index, dtype=None if index else torch.long)
    if isinstance(index, Tensor) and index.ndim <= 1:
        whole = index.dtype in (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
        if whole or (index.dtype == torch.bool and index.shape == (images,)):
            places = index.reshape(-1).to(device)
            if whole and not is_hidden(places) and len(places):
                _check_inside(int(places.min()), images)
                _check_inside(int(places.max()), images)
            return places.long() if whole else places
    if isinstance(index, slice):
        start, stop, step = index.indices(images)
        return slice(start, stop, step) if step > 0 else torch.arange(start, stop, step, device=device)
    if isinstance(index, int) and not isinstance(index, bool):
        _check_inside(index, images)
        return slice(index % images, index % images + 1)
    raise TypeError(
        f"index must be an int, a slice, a list of ints, or a tensor of ints or of {images} bools, "
        f"got {_shown(index)}; pass 0 for the first image, for example"
    )


def _check_inside(index: int, images: int) -> None:
    """Raise unless there is an image of that number."""
    if not -images <= index < images:
        wanted = f"from {-images} to {images - 1}" if images else "absent, as there are no images"
        raise IndexError(f"index must be {wanted}, got {index}; see len() for the number of images")


def _select(index: slice | Tensor, images: int, tensor: Tensor, path: Path) -> Tensor:
    """The entries of some images, or all if there is one for all images."""
    if path & SHARED or tensor.ndim == 0 or len(tensor) != images:
        return tensor
    return tensor[index]


def joined(batches: Sequence[Container], counts: Sequence[int]) -> Container:
    """Join dataclasses of tensors with these numbers of images along the first dimension.

    Raises:
        ValueError: if anything but the entries of images differs.
    """
    if torch.is_inference_mode_enabled():
        with torch.inference_mode(False), torch.no_grad():
            return joined(batches, counts)
    result: Container = _Joining(counts).join(batches, "")
    return result


class _Joining:
    """Batches that are joined, with these numbers of images."""

    def __init__(self, counts: Sequence[int]) -> None:
        self.counts = counts

    def join(self, values: Sequence[Any], name: str) -> Any:
        """Join the values of a field."""
        first = values[0]
        if all(isinstance(value, Tensor) for value in values):
            return self._tensors(values, name)
        if name in MEASURED:
            return max(values)
        numbers = all(isinstance(value, Tensor | int | float) for value in values)
        if name in BANDWIDTHS and numbers and len(set(values)) > 1:
            return self._tensors([_tensor(value) for value in values], name)
        self._check(len({type(value) for value in values}) == 1, name, values)
        if isinstance(first, tuple):
            self._check(len({len(value) for value in values}) == 1, name, values)
            return tuple(self.join(items, name) for items in zip(*values, strict=True))
        if is_dataclass(first) and not isinstance(first, type):
            joint = {f.name: self.join([getattr(value, f.name) for value in values], f.name) for f in fields(first)}
            return replace(first, **joint)
        self._check(all(value == first for value in values[1:]), name, values)
        return first

    def _tensors(self, values: Sequence[Tensor], name: str) -> Tensor:
        """Join tensors; those of one entry serve for all images of their batch."""
        first = values[0]
        if name in SHARED:
            same = len({value.shape for value in values}) == 1
            self._check(same and (is_hidden(first) or all(value.equal(first) for value in values)), name, values)
            return first
        parts = [value.reshape(-1, *value.shape[1:]) for value in values]
        self._check(len({part.shape[1:] for part in parts}) == 1, name, values)
        batches = zip(self.counts, parts, strict=True)
        return torch.cat([part.expand(count, *part.shape[1:]) for count, part in batches])

    def _check(self, agreed: bool, name: str, values: Sequence[Any]) -> None:
        if not agreed:
            kinds = [tuple(value.shape) if isinstance(value, Tensor) else value for value in values]
            seen = list(dict.fromkeys(v if isinstance(v, tuple) else _shown(v) for v in kinds))
            got = " and ".join(map(str, seen[:2])) if len(seen) > 1 else "different values"
            raise ValueError(
                f"batches must have the same {name} to be joined, got {got}; build them with equal options"
            )


def _shown(value: object) -> str:
    """A value of any type in one line."""
    return repr(value) if value is None or isinstance(value, str | int | float) else type(value).__name__


def _tensor(value: float | Tensor) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)


def check_batches(batches: object, kind: type[Batch]) -> None:
    """Raise unless these are batches of that type, and alike in shape, dtype and device."""
    called = kind.__name__
    if not isinstance(batches, Sequence) or isinstance(batches, str | Batch) or len(batches) == 0:
        got = "none" if isinstance(batches, Sequence) and len(batches) == 0 else _shown(batches)
        raise TypeError(f"batches must be a list of at least one {called}, got {got}; pass [first, second]")
    for batch in batches:
        if not isinstance(batch, kind):
            raise TypeError(
                f"each of the batches must be a {called}, got {type(batch).__name__}; pass those of different images"
            )
    for name, values in {
        "number of landmarks": [batch.factor.shape[1] for batch in batches],
        "number of pixels": [batch.factor.shape[2] for batch in batches],
        "dtype": [batch.dtype for batch in batches],
        "device": [batch.device for batch in batches],
    }.items():
        different = [value for value in values if value != values[0]]
        if different:
            raise ValueError(
                f"batches must have the same {name} to be joined, got {values[0]} and {different[0]}; "
                "build or convert them alike"
            )


def collate(samples: Sequence[Any]) -> Any:
    """Join the samples of a data set to a batch: ``DataLoader(..., collate_fn=collate)``.

    Operators and spectra are joined by ``cat``, everything else as by :func:`torch.utils.data.default_collate`, also in
    tuples, lists and dictionaries.

    Args:
        samples: the samples, all of the same structure.

    Raises:
        TypeError, ValueError: if the samples differ in structure, or in anything but the entries of images.

    Example:
        >>> from nlfilter_torch import nonlocal_operator
        >>> guides = torch.rand(2, 1, 16, 16, generator=torch.Generator().manual_seed(0))
        >>> samples = [(guide, nonlocal_operator(guide[None], num_landmarks=9)) for guide in guides]
        >>> images, operators = collate(samples)
        >>> (operators @ images).shape
        torch.Size([2, 1, 16, 16])
    """
    if not isinstance(samples, Sequence) or len(samples) == 0:
        got = "none" if isinstance(samples, Sequence) else _shown(samples)
        raise TypeError(f"samples must be a list of at least one sample, got {got}; pass [sample]")
    first = samples[0]
    if isinstance(first, Batch):
        return type(first).cat(samples)
    if isinstance(first, Mapping):
        return {name: collate([sample[name] for sample in samples]) for name in first}
    if isinstance(first, tuple | list):
        lengths = {len(sample) for sample in samples}
        if len(lengths) > 1:
            raise ValueError(f"samples must have the same length, got {sorted(lengths)}; return the same parts for all")
        parts = [collate(list(part)) for part in zip(*samples, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else parts
    from torch.utils.data import default_collate

    return default_collate(list(samples))
