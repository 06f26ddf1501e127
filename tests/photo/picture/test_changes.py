"""Changes of detail: less of it in flat areas."""

import pytest
import torch

from nlfilter_torch.photo import enhance
from nlfilter_torch.photo.picture.changes import limit_by_activity, split_sliders
from tests.brightness import ALPHA


def test_calm_areas_are_strengthened_less_and_smoothed_alike() -> None:
    changes = torch.tensor([0.4, 0.1]).view(1, 2, 1, 1).expand(1, 2, 1, 3)
    variance = torch.tensor([0.0, 1e-4, 1.0]).view(1, 1, 1, 3)
    limited = limit_by_activity(changes, variance, 0.01).flatten()
    torch.testing.assert_close(limited, torch.tensor([0.1, 0.3, 0.5]), atol=1e-4, rtol=0)
    assert torch.equal(limit_by_activity(changes, variance, 0.0), torch.full((1, 1, 1, 3), 0.5))
    added, rest = split_sliders(torch.tensor([0.5, -0.5, 2.0, 0.3]))
    assert added.tolist() == [0.5, 0.0, 2.0, 0.0]
    assert (added + rest).tolist() == pytest.approx([0.5, -0.5, 2.0, 0.3])
    noise = 0.5 + 2 / 255 * torch.randn(1, 1, 60, 60, generator=torch.Generator().manual_seed(0))
    noise[..., 58:, :30], noise[..., 58:, 30:] = 0.0, 1.0  # so that it uses its range
    edited = [enhance(noise, ALPHA, threshold=t, num_landmarks=60) for t in (0.0, 5 / 255, 50 / 255)]
    stds = [image[..., :50, :].std() for image in edited]
    assert stds[0] > 1.2 * stds[1]
    assert stds[1] > stds[2]
    assert stds[2] < 1.05 * noise[..., :50, :].std()
    smooth = [enhance(noise, torch.tensor([0.0, 0.0, 1.0]), threshold=t, num_landmarks=60) for t in (0.0, 0.1)]
    assert torch.equal(smooth[0], smooth[1])
