"""An image in memory as the source of an edit."""

import torch

from nlfilter_torch.operator.options import OperatorOptions
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.source import Guide


def test_the_last_operator_with_the_same_options_is_cached() -> None:
    source = InMemory(torch.rand(1, 1, 12, 13), {})
    learned, written = torch.tensor([3.0], requires_grad=True), torch.tensor([3.0])

    def operator(*bandwidths: float | torch.Tensor) -> object:
        return source.operator(Guide(OperatorOptions(spatial_bandwidth=bandwidths, num_landmarks=20)))

    def tensors(*bandwidths: float) -> object:
        return operator(*(torch.tensor([bandwidth]) for bandwidth in bandwidths))

    assert tensors(3.0, 5.0) is tensors(3.0, 5.0)
    assert tensors(3.0, 5.0) is not tensors(5.0, 3.0)
    assert operator(3.0, 5.0) is operator(3.0, 5.0)
    assert operator(written, 5.0) is not operator(written, 3.0)
    assert operator(learned, learned) is not operator(learned, learned)
    before = operator(written, written)
    written += 1
    assert operator(written, written) is not before
    assert len(source.cache or {}) == 4
