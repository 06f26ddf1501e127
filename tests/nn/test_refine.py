"""The layer that refines logits and masks."""

from typing import Any

import torch

from nlfilter_torch import Refine, nonlocal_operator, refine
from tests.problems import noise

OPTIONS: dict[str, Any] = {"num_landmarks": 20, "landmarks": "uniform"}
LOGITS, GUIDE = 3 * noise(2, 3, 12, 13, dtype=torch.float32), noise(2, 3, 12, 13, seed=1, dtype=torch.float32)


def test_layer_is_the_function() -> None:
    confidence = noise(2, 1, 12, 13, seed=2, dtype=torch.float32)
    torch.testing.assert_close(Refine(**OPTIONS)(LOGITS, GUIDE), refine(LOGITS, GUIDE, **OPTIONS))
    options: dict[str, Any] = {"steps": 2, "strength": 2.0, "margin": 3.0, "caution": None, "spatial_bandwidth": 5.0}
    torch.testing.assert_close(
        Refine(**OPTIONS, **options)(LOGITS, GUIDE, confidence),
        refine(LOGITS, GUIDE, confidence=confidence, **OPTIONS, **options),
    )
    operator = nonlocal_operator(GUIDE, num_landmarks=20)
    torch.testing.assert_close(Refine()(LOGITS, operator), refine(LOGITS, operator))
    mask = LOGITS[:, :1].sigmoid()
    torch.testing.assert_close(Refine(kind="mask", **OPTIONS)(mask, GUIDE), refine(mask, GUIDE, kind="mask", **OPTIONS))


def test_everything_is_learned() -> None:
    layer = Refine(
        classes=3,
        photometric_bandwidth=0.2,
        spatial_bandwidth=5.0,
        learn=("strength", "margin", "compatibility", "photometric_bandwidth", "spatial_bandwidth"),
        **OPTIONS,
    )
    layer(LOGITS, GUIDE)[:, 0].square().mean().backward()
    names = dict(layer.named_parameters())
    assert len(names) == 5
    for parameter in names.values():
        assert parameter.grad is not None
        assert bool(parameter.grad.isfinite().all())
        assert bool((parameter.grad != 0).any())
    copy = Refine(
        classes=3, photometric_bandwidth=1.0, spatial_bandwidth=1.0, learn=[n.removeprefix("log_") for n in names]
    )
    copy.load_state_dict(layer.state_dict())
    assert "strength=4" in repr(copy)


def test_learning_lowers_the_loss() -> None:
    truth = (GUIDE[:, :1] > 0.5).long().squeeze(1)
    logits = torch.stack([1 - truth.float(), truth.float()], 1) * 2 + 3 * noise(2, 2, 12, 13, seed=4).float()
    layer = Refine(caution=None, strength=0.2, photometric_bandwidth=0.3, **OPTIONS)
    optimiser, losses = torch.optim.Adam(layer.parameters(), lr=0.1), []
    for _ in range(15):
        loss = torch.nn.functional.cross_entropy(layer(logits, GUIDE), truth)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]
