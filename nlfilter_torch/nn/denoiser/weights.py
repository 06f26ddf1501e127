"""Reading weights from a safetensors file, with checks of names and shapes."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

LENGTH = 8  # size in bytes of the first field, the length of the header


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Read float32 tensors of the given names and shapes.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or lacks a tensor of that name and shape.
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
        weights = {name: _tensor(entry, memoryview(content)[end:]) for name, entry in header.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"weights must be a complete safetensors file, but {path} is damaged: {error}") from None
    for name, shape in shapes.items():
        got = tuple(weights[name].shape) if name in weights else None
        if got != shape:
            raise ValueError(
                f"weights must hold {name} of shape {shape}, but {path} has {'none' if got is None else got}; "
                "they belong to another layer"
            )
    return {name: weights[name] for name in shapes}


def _tensor(entry: Mapping[str, Any], data: memoryview) -> Tensor:
    if entry["dtype"] != "F32":
        raise ValueError(f"numbers must be F32, got {entry['dtype']}")
    start, stop = entry["data_offsets"]
    if not 0 <= start <= stop <= len(data):
        raise ValueError("it ends early")
    return torch.tensor(np.frombuffer(data[start:stop], "<f4").reshape(entry["shape"]))
