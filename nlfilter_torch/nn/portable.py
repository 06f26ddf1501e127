"""A layer in the form that is exported to ONNX and to programs that run without Python."""

from typing import Any

import torch
from torch import nn

from nlfilter_torch.core.checks import check_instance
from nlfilter_torch.operator.portable import PortableForms


class Portable(nn.Module):
    """A model that is exported as operations of torch alone, without operators of this package.

    ``torch.onnx.export`` and AOTInductor take it; such programs run without Python. While it is exported, every
    operator that the model builds is computed in a fixed number of steps: the Nystrom factor by an inverse square root
    in place of a Cholesky factor, the scaling by Chebyshev's iteration. Results differ by rounding, but for rare images
    in which pixels would be isolated or eigenvalues of 1 exceeded, which accelerators leave as they are, too. Otherwise
    it is the model itself.

    Args:
        module: the model, with :class:`NonlocalFilter` or other layers and functions of this package inside. Landmarks
            by k-means are at most 256. Spectra, and with them a ``residual``, cannot be exported.

    Raises:
        TypeError: if ``module`` is no module.

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
        """What the module returns."""
        if not torch.compiler.is_compiling():
            return self.module(*args, **kwargs)
        with PortableForms():
            return self.module(*args, **kwargs)
