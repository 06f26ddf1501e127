"""Edits from a source to a target of rows."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.tiles import FEW, cat, streamed


def test_report_tells_every_stage_and_its_end() -> None:
    seen: list[tuple[str, int, int]] = []
    streamed(
        cat(40, 60), sample=1000, num_landmarks=20, tile_rows=25, memory=FEW, report=lambda *step: seen.append(step)
    )
    stages = list(dict.fromkeys(stage for stage, _, _ in seen))
    assert stages == ["Looking", "Sampling", "Balancing", "Bounding", "Summing up", "Filtering"]
    assert seen[-3:] == [("Filtering", 0, 40), ("Filtering", 25, 40), ("Filtering", 40, 40)]


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (lambda p: p[..., :0], {}, ValueError, r"source must have the shape \(H, W\) or \(H, W, S\)"),
        (lambda p: np.concatenate([p, p], axis=2), {}, ValueError, "one to four channels"),
        (lambda p: p.astype(np.int32), {}, TypeError, "source must hold one of uint8, .* got int32"),
        (lambda p: np.where(p > 0.5, np.nan, p), {}, ValueError, "source holds NaN or infinite pixels"),
        (lambda p: p, {"statistics": "some"}, ValueError, "statistics must be one of"),
        (lambda p: p, {"channels": "red"}, ValueError, "channels must be one of"),
        (lambda p: p, {"sample": 0}, ValueError, "sample must be at least 1"),
        (lambda p: p, {"tile_rows": 0}, ValueError, "tile_rows must be at least 1"),
        (lambda p: p, {"residual": float("nan")}, ValueError, "residual must be finite"),
        (lambda p: p, {"alpha": torch.ones(1, 3)}, ValueError, "alpha must have shape"),
        (lambda p: p, {"num_landmarks": 0}, ValueError, "num_landmarks must be at least 1"),
        (lambda p: p, {"photometric_bandwidth": -1.0}, ValueError, "photometric_bandwidth must be positive"),
        (lambda p: p, {"photometric_bandwidth": "wide"}, ValueError, "photometric_bandwidth must be one of"),
        (lambda p: p, {"spatial_bandwidth": 0.0}, ValueError, "spatial_bandwidth must be positive"),
        (lambda p: p, {"landmarks": "best"}, ValueError, "landmarks must be one of"),
        (lambda p: p, {"completion": "all"}, ValueError, "completion must be one of"),
        (lambda p: p, {"guide_channels": "red"}, ValueError, "guide_channels must be one of"),
        (lambda p: p, {"patch_size": 4}, ValueError, "patch_size must be odd"),
        (lambda p: p, {"tolerance": 1e-3}, TypeError, "tolerance"),
    ],
)
def test_what_cannot_be_used_is_named(change: Any, options: dict[str, Any], error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        streamed(change(cat(20, 30)), **options)
