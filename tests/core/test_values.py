"""Whether values can be read, and which transforms of torch are refused while an operator is built."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor
from torch.func import grad

from nlfilter_torch import (
    NonlocalFilter,
)
from tests.layers import OPTIONS, image


def test_function_transforms_of_building_an_operator_are_refused() -> None:
    with pytest.raises(TypeError, match=r"must not be transformed by torch\.func"):
        grad(lambda y: NonlocalFilter(**OPTIONS)(y).square().mean())(image())


def test_building_inside_a_transform_is_refused_with_a_remedy() -> None:
    layer, picture = NonlocalFilter(num_landmarks=10), image()
    parameters = {name: value.detach() for name, value in layer.named_parameters()}

    def loss(values: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(layer, values, (picture,)).square().sum()

    with pytest.raises(TypeError, match=r"inside torch\.func .*; build the operator before"):
        grad(loss)(parameters)


FIRST_CALLS = """
import contextlib
import torch
from nlfilter_torch import denoise, enhance
image = torch.linspace(0.1, 0.9, 3 * 48 * 48, dtype=torch.float64).view(1, 3, 48, 48)
calls = [
    lambda image: denoise(image, noise_level=0.1),
    lambda image: enhance(image, torch.tensor([2.0, 2.0, 1.0, 1.0]), viewing_size=0.0008, num_landmarks=20),
]
for call in calls:
    with FIRST, contextlib.suppress(RuntimeError):  # kornia refuses another default device
        call(image.to(DEVICE))
    call(image.clone().requires_grad_()).sum().backward()
"""


@pytest.mark.parametrize(
    ("first", "device"), [("torch.inference_mode()", "'cpu'"), ("torch.device('meta')", "'meta'")], ids=str
)
def test_later_calls_do_not_depend_on_the_mode_of_the_first(first: str, device: str) -> None:
    """Constants are computed in the first call, in a process of its own here."""
    code = FIRST_CALLS.replace("FIRST", first).replace("DEVICE", device)
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
