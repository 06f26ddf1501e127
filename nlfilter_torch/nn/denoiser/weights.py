"""Weights from safetensors files, with checks of names and shapes."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors.numpy
import torch
from torch import Tensor


def read_weights(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Read float32 tensors of the given names and shapes.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or lacks a tensor of that name and shape.
    """
    try:
        weights = safetensors.numpy.load(path.read_bytes())
    except OSError as error:
        raise FileNotFoundError(
            f"weights must be a safetensors file, but {path} cannot be read: {error.strerror}; reinstall "
            "the package, or choose another file"
        ) from None
    except safetensors.SafetensorError as error:
        raise ValueError(f"weights must be a complete safetensors file, but {path} is damaged: {error}") from None
    except KeyError as error:  # a type that numpy lacks, such as bfloat16
        raise ValueError(f"weights must be numbers of float32, but {path} has {error}; convert them") from None
    for name, shape in shapes.items():
        got = tuple(weights[name].shape) if name in weights else None
        if got != shape:
            raise ValueError(
                f"weights must hold {name} of shape {shape}, but {path} has {'none' if got is None else got}; "
                "they belong to another layer"
            )
        if weights[name].dtype != np.float32:
            raise ValueError(f"weights must be numbers of float32, but {path} has {weights[name].dtype}; convert them")
    return {name: torch.tensor(weights[name]) for name in shapes}
