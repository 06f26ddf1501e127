"""A wrapper for exporting models to ONNX and to programs that run without Python."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from nlfilter_torch.core.checks import check_instance
from nlfilter_torch.core.torch_internals import DEFINITIONS


class Portable(nn.Module):
    """Wrapper that lets a model be exported as operations of torch alone, without custom operators of this package.

    It can be passed to ``torch.onnx.export`` and AOTInductor, whose programs run without Python. In the exported
    program, operators are built in a fixed number of steps: the Nystrom factor by an inverse square root in place of a
    Cholesky factor, the scaling by Chebyshev iteration. Results differ by rounding only, except for rare images in
    which isolated pixels would be removed or eigenvalues above 1 reduced; as on accelerators, this is not done. When
    not being exported, the wrapper behaves like the model.

    Args:
        module: the model, which may use :class:`NonlocalFilter` and other layers and functions of this package.
            Landmarks must be given, as an operator or as features, or be the uniform grid: what chooses others is not
            exported, and neither are spectra, and therefore ``residual``.

    Raises:
        TypeError: if ``module`` is not a module.
        ValueError: on export, if a layer chooses landmarks by k-means or at random.

    Example:
        >>> from nlfilter_torch import NonlocalFilter, nonlocal_operator
        >>> image = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0))
        >>> operator = nonlocal_operator(image, num_landmarks=20)
        >>> layer = NonlocalFilter(alpha=(3, 3, 4, 1.05), landmarks=operator, hold="features")
        >>> torch.equal(Portable(layer)(image), layer(image))
        True
    """

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        check_instance(module, nn.Module, "module", "pass a layer such as NonlocalFilter()")
        self.module = module

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Call the module."""
        if not torch.compiler.is_compiling():
            return self.module(*args, **kwargs)
        with ThroughDefinitions():
            return self.module(*args, **kwargs)


class ThroughDefinitions(TorchFunctionMode):
    """Context in which a program is traced through the operators of ``torch.ops.nlfilter``, which runtimes lack."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call the definition of an operator of this package, or any other function itself."""
        if func is torch.hypot:
            return root_of_squares(*args)
        if func not in DEFINITIONS:
            return func(*args, **(kwargs or {}))
        with self:  # a mode is not active in its own function, and definitions call one another
            return DEFINITIONS[func](*args, **(kwargs or {}))


def root_of_squares(down: Tensor, right: Tensor) -> Tensor:
    """As :func:`torch.hypot`, which ONNX lacks, except that squares of values above 1e19 overflow."""
    return (down.square() + right.square()).sqrt()
