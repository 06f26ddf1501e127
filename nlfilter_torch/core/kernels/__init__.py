"""Operators of ``torch.ops.nlfilter``: each has a definition in torch and a kernel in C for float32 on CPUs.

Torch's dispatcher chooses between the two; within :func:`definitions_only` the kernels are not used.
"""

from nlfilter_torch.core.kernels.library import definitions_only as definitions_only
