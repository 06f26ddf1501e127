"""Precision of functions and of their derivatives, and gradients of low rank."""

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    nonlocal_operator,
    spectral_filter,
)
from nlfilter_torch.core.precision import WITHOUT_TF32, full_precision
from nlfilter_torch.core.torch_internals import OuterProduct
from tests.problems import noise, seeded

SIZE = (5, 4)


# Without completion, the method itself breaks down at a small bandwidth.
BANDWIDTHS = {"diagonal": 0.2, "none": 0.8}


def small(channels: int = 1, seed: int = 0, batch: int = 1) -> Tensor:
    return noise(batch, channels, *SIZE, seed=seed).requires_grad_()


def build(guide: Tensor, completion: str, **options: object) -> NonlocalOperator:
    options = {"photometric_bandwidth": BANDWIDTHS[completion], "num_landmarks": 7, "patch_size": 3} | options
    return nonlocal_operator(guide, completion=completion, guide_channels="all", **options)  # type: ignore[arg-type]


def weighted(tensor: Tensor, seed: int = 9) -> Tensor:
    """A sum with a different weight for every entry."""
    return (tensor * torch.randn(tensor.shape, generator=seeded(seed), dtype=tensor.dtype)).sum()


@pytest.mark.parametrize("inputs", ["guide", "everything"])
def test_second_derivatives_through_the_operator_are_refused(inputs: str) -> None:
    guide, image = small(), small(seed=1).detach()
    losses = {
        "products": lambda operator: weighted(operator @ guide),
        "spectrum": lambda operator: weighted(spectral_filter(operator.spectrum(), image, torch.sqrt)),
        "scaling": lambda operator: weighted(operator.scaling),
    }
    for loss in losses.values():
        first = torch.autograd.grad(loss(build(guide, "diagonal")), guide, create_graph=True)[0]
        with pytest.raises(RuntimeError, match="must not be differentiated twice"):
            first.square().sum().backward(inputs=[guide] if inputs == "guide" else None)


def test_gradient_of_the_factor_is_an_ordinary_tensor_to_whoever_looks() -> None:
    # Internally it is a product of two low-rank factors, which are concatenated when gradients are added.
    operator = build(small(), "diagonal")
    image = noise(1, 2, *SIZE, seed=1)

    def gradient(loss: Tensor) -> Tensor:
        return torch.autograd.grad(loss, operator.factor, retain_graph=True)[0]

    once, twice = weighted(operator @ image), weighted(operator @ (operator @ image))
    together = gradient(once + twice + operator.factor.square().sum())
    torch.testing.assert_close(together, gradient(once) + gradient(twice) + 2 * operator.factor)
    torch.testing.assert_close(gradient(once + twice), gradient(once) + gradient(twice))
    assert isinstance(gradient(once), OuterProduct)
    assert gradient(once)[0, 0].tolist() == gradient(once).clone()[0, 0].tolist()
    wide = weighted(operator @ noise(1, 20, *SIZE, seed=2))  # with so many channels that the full matrix is smaller
    assert not isinstance(gradient(wide), OuterProduct)
    torch.testing.assert_close(gradient(once + wide), gradient(once) + gradient(wide))


def test_importing_and_running_does_not_load_the_compiler() -> None:
    import subprocess

    program = (
        "import sys, torch, nlfilter_torch\n"
        "before = 'torch._dynamo' in sys.modules\n"
        "nlfilter_torch.NonlocalFilter(num_landmarks=4)(torch.rand(1, 1, 8, 8)).sum().backward()\n"
        "assert before or 'torch._dynamo' not in sys.modules\n"
        "assert not before"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def settings() -> tuple[bool, bool]:
    return torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32


@pytest.fixture
def tf32() -> Iterator[None]:
    """TF32 is allowed, as a user may have set it."""
    before = settings()
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    yield
    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


@pytest.mark.usefixtures("tf32")
def test_tf32_is_off_inside_and_as_before_outside_also_after_an_error() -> None:
    with WITHOUT_TF32, WITHOUT_TF32:
        assert settings() == (False, False)
    assert settings() == (True, True)
    with pytest.raises(ZeroDivisionError), WITHOUT_TF32:
        _ = 1 / 0
    assert settings() == (True, True)


@pytest.mark.usefixtures("tf32")
def test_threads_that_overlap_leave_tf32_as_it_was() -> None:
    """Each enters before the one before it leaves, so that all but the first find TF32 turned off."""
    entered, leave = [Event() for _ in range(4)], [Event() for _ in range(4)]
    inside: list[tuple[bool, bool]] = []

    def work(number: int) -> None:
        with WITHOUT_TF32:
            entered[number].set()
            assert leave[number].wait(10)
            inside.append(settings())

    with ThreadPoolExecutor(4) as threads:
        done = []
        for number in range(4):
            done.append(threads.submit(work, number))
            assert entered[number].wait(10)
        for number in (0, 2, 1, 3):
            assert settings() == (False, False)
            leave[number].set()
            done[number].result(10)
    assert inside == [(False, False)] * 4
    assert settings() == (True, True)


@pytest.mark.usefixtures("tf32")
def test_many_threads_at_once_never_see_tf32_inside() -> None:
    def work(_: int) -> bool:
        with WITHOUT_TF32:
            return settings() == (False, False)

    with ThreadPoolExecutor(8) as threads:
        assert all(threads.map(work, range(400)))
    assert settings() == (True, True)


@pytest.mark.usefixtures("tf32")
def test_where_there_is_a_gpu_functions_run_without_tf32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    seen = full_precision(lambda image: settings())(torch.ones(1))
    assert seen == (False, False)
    assert settings() == (True, True)
