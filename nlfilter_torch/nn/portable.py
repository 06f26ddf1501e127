"""A wrapper for exporting models to ONNX and to programs that run without Python."""

from typing import Any

import torch
from torch import nn

from nlfilter_torch.core.checks import check_instance
from nlfilter_torch.operator.portable import PortableForms


class Portable(nn.Module):
    """Wrapper that lets a model be exported as operations of torch alone, without custom operators of this package.

    It can be passed to ``torch.onnx.export`` and AOTInductor, whose programs run without Python. In the exported
    program, operators are built in a fixed number of steps: the Nystrom factor by an inverse square root in place of a
    Cholesky factor, the scaling by Chebyshev iteration. Results differ by rounding only, except for rare images in
    which isolated pixels would be removed or eigenvalues above 1 reduced; as on accelerators, this is not done. When
    not being exported, the wrapper behaves like the model.

    Args:
        module: the model, which may use :class:`NonlocalFilter` and other layers and functions of this package.
            Landmarks by k-means are limited to 256. Spectra, and therefore ``residual``, cannot be exported.

    Raises:
        TypeError: if ``module`` is not a module.

    Example:
        >>> from nlfilter_torch import NonlocalFilter
        >>> layer = NonlocalFilter(alpha=(3, 3, 4, 1.05), num_landmarks=20)
        >>> image = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0))
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
        with PortableForms():
            return self.module(*args, **kwargs)
