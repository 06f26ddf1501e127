"""Peak memory and rounding error of one case, each measured separately from the timings.

``python -m benchmarks.speed.probe WORK JSON``, run as a fresh process, does its work once and prints a line of JSON.
"""

import json
import sys
from dataclasses import asdict, replace

import torch
from torch import Tensor

from benchmarks.harness import MIB, forget_peak, in_fresh_process, resident
from benchmarks.speed.cases import Case
from nlfilter_torch import NonlocalFilter
from nlfilter_torch.operator.nystrom import inverse_cholesky
from nlfilter_torch.operator.scaling import KernelMatrix
from nlfilter_torch.operator.sinkhorn import sinkhorn_balance

ALPHA = (3.0, 3.0, 4.0, 1.05)


def peak_memory(case: Case, work: str) -> dict[str, float]:
    """Peak memory in MiB that ``"operator"`` or ``"training step"`` adds to a process that holds the image."""
    return in_fresh_process("speed.probe", work, json.dumps(asdict(case) | {"threads": case.used_threads}))


def training_step(case: Case, image: Tensor) -> None:
    """Filter an image and differentiate with respect to the image and alpha."""
    layer = NonlocalFilter(ALPHA, **case.options())
    layer(image.requires_grad_()).square().mean().backward()


def build(case: Case, image: Tensor) -> None:
    """Build the operator, nothing else."""
    with torch.no_grad():
        case.operator(image)


WORKS = {"operator": build, "training step": training_step}


def rounding_error(case: Case, image: Tensor) -> dict[str, float]:
    """Difference between ``W y`` and the same filter in float64, with the same landmarks, in grey levels of 255.

    Landmark selection is discrete, so rounding may change it. Both filters therefore use the landmarks of the case
    itself; the remaining difference is rounding and the tolerance of the balancing.
    """
    with torch.no_grad():
        operator = case.operator(image)
        result = (operator @ image).double()
        kernel = operator.kernel
        points = kernel.landmarks.double()
        recipe = replace(
            kernel.recipe,
            patch_weights=kernel.recipe.patch_weights.double(),
            photometric_bandwidth=torch.as_tensor(kernel.recipe.photometric_bandwidth).double(),
        )
        exact_kernel = replace(kernel, landmarks=points, inverse_cholesky=inverse_cholesky(points), features=recipe)
        factor, diagonal = exact_kernel.columns(image.double())
        scaling = sinkhorn_balance(KernelMatrix(factor, diagonal)).scaling
        remainder = scaling.square() * diagonal
        exact = replace(operator, factor=factor, diagonal=diagonal, scaling=scaling, remainder=remainder)
        difference = 255 * (result - exact @ image.double())
    return {"rms": difference.square().mean().sqrt().item(), "max": difference.abs().max().item()}


def held(case: Case) -> tuple[float, float]:
    """Current and peak memory in MiB: of the process on the CPU, of torch's allocator on an accelerator."""
    if case.device == "cpu":
        return resident("VmRSS"), resident("VmHWM")
    return torch.cuda.memory_allocated() / MIB, torch.cuda.max_memory_allocated() / MIB


def main() -> None:
    """Measure one case in this process."""
    work, fields = sys.argv[1], json.loads(sys.argv[2])
    case = Case(**fields)
    torch.set_num_threads(case.used_threads)
    import kornia.color
    import kornia.filters  # noqa: F401  imported by the package on first use, which is not to be measured

    image = case.image()
    forget_peak()
    before, _ = held(case)
    WORKS[work](case, image)
    _, peak = held(case)
    print(json.dumps({"added_mib": peak - before, "process_mib": peak, "factor_mib": case.factor_bytes / MIB}))


if __name__ == "__main__":
    main()
