"""Operators of ``torch.ops.nlfilter``: each defined in torch, with a kernel in C for float32 on processors beside it.

Torch's dispatcher chooses between the two; :func:`definitions_only` keeps it from the kernels.
"""

from nlfilter_torch.core.kernels.library import definitions_only as definitions_only
