"""Weights from a safetensors file, checked against what a layer needs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

LENGTH = 8  # bytes of the header's length, which come first


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Tensors of these names and shapes, in float32.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, or holds other tensors.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileNotFoundError(
            f"weights must be a safetensors file, but {path} cannot be read: {error.strerror}; reinstall "
            "the package, or choose another file"
        ) from None
    try:
        end = LENGTH + int.from_bytes(content[:LENGTH], "little")
        header = json.loads(content[LENGTH:end])
        header.pop("__metadata__", None)
        found = {name: _tensor(entry, memoryview(content)[end:]) for name, entry in header.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"weights must be a complete safetensors file, but {path} is damaged: {error}") from None
    for name, shape in shapes.items():
        got = tuple(found[name].shape) if name in found else None
        if got != shape:
            raise ValueError(
                f"weights must hold {name} of shape {shape}, but {path} has {'none' if got is None else got}; "
                "they belong to another layer"
            )
    return {name: found[name] for name in shapes}


def _tensor(entry: Mapping[str, Any], data: memoryview) -> Tensor:
    if entry["dtype"] != "F32":
        raise ValueError(f"numbers must be F32, got {entry['dtype']}")
    start, stop = entry["data_offsets"]
    if not 0 <= start <= stop <= len(data):
        raise ValueError("it ends early")
    return torch.tensor(np.frombuffer(data[start:stop], "<f4").reshape(entry["shape"]))
