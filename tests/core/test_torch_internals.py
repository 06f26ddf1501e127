"""Private parts of torch answer the questions that they are used for, and stand in one module."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad
from torch.func import grad

import nlfilter_torch
from nlfilter_torch import (
    NonlocalFilter,
)
from nlfilter_torch.core import torch_internals as internals
from tests.layers import OPTIONS, image


def test_transforms_are_noticed() -> None:
    seen = []

    def function(x: Tensor) -> Tensor:
        seen.append((internals.is_transformed(x), internals.in_transform()))
        return x.sum()

    function(torch.ones(3))
    torch.func.grad(function)(torch.ones(3))
    torch.func.vmap(function)(torch.ones(2, 3))
    assert seen == [(False, False), (True, True), (True, True)]
    assert not internals.in_transform()


def test_forward_mode_is_noticed() -> None:
    assert not internals.in_forward_mode()
    with forward_ad.dual_level():
        assert internals.in_forward_mode()


def test_fake_tensors_are_noticed() -> None:
    assert not internals.in_fake_mode()
    with FakeTensorMode():
        assert internals.in_fake_mode()
        assert internals.is_fake_tensor(torch.ones(2))


def test_tracing_is_noticed() -> None:
    assert not internals.is_traced()


def test_tensors_without_memory_and_nested_replacement() -> None:
    class Marked(Tensor):
        @classmethod
        def __torch_dispatch__(cls, func: object, types: object, args: object = (), kwargs: object = None) -> None:
            raise AssertionError

    marked = internals.without_memory(Marked, (2, 3), torch.ones(1, dtype=torch.float64))
    assert isinstance(marked, Marked)
    assert (tuple(marked.shape), marked.dtype) == ((2, 3), torch.float64)
    nested = internals.replace_instances(Marked, lambda _: "replaced", ([marked, 1], {"a": marked}))
    assert nested == (["replaced", 1], {"a": "replaced"})


def test_no_other_module_uses_private_parts_of_torch() -> None:
    root = Path(nlfilter_torch.__file__).parent
    for path in root.rglob("*.py"):
        if path == Path(internals.__file__):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            parts: list[str] = []
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "torch":
                parts = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            elif isinstance(node, ast.Attribute) and re.fullmatch(r"(torch|dist|forward_ad)[\w.]+", ast.unparse(node)):
                parts = ast.unparse(node).split(".")
            private = [part for part in parts if re.match("_[^_]", part)]
            assert not private, (path, private)


FIRST_CALLS = """
import contextlib
import torch
from nlfilter_torch.photo import denoise, enhance
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


def test_function_transforms_of_building_an_operator_are_refused() -> None:
    with pytest.raises(TypeError, match=r"must not be transformed by torch\.func"):
        grad(lambda y: NonlocalFilter(**OPTIONS)(y).square().mean())(image())


def test_an_operator_of_a_fixed_guide_is_built_outside_the_transform() -> None:
    layer, picture = NonlocalFilter(num_landmarks=10), image()
    parameters = {name: value.detach() for name, value in layer.named_parameters()}

    def loss(values: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(layer, values, (picture,)).square().sum()

    expected = torch.autograd.grad(layer(picture).square().sum(), list(layer.parameters()))
    torch.testing.assert_close(list(grad(loss)(parameters).values()), list(expected))


@pytest.mark.parametrize(
    ("first", "device"), [("torch.inference_mode()", "'cpu'"), ("torch.device('meta')", "'meta'")], ids=str
)
def test_later_calls_do_not_depend_on_the_mode_of_the_first(first: str, device: str) -> None:
    """Constants are computed in the first call, in a process of its own here."""
    code = FIRST_CALLS.replace("FIRST", first).replace("DEVICE", device)
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
