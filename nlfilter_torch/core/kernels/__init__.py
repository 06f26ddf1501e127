"""Operators of ``torch.ops.nlfilter``: each has a definition in torch and a kernel in C for CPUs.

Torch's dispatcher chooses between the two; within :func:`definitions_only` the kernels are not used. Importing this
package loads the library of the kernels, if the installation has one.
"""

from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.kernels.library import definitions_only as definitions_only
from nlfilter_torch.core.kernels.library import use

if (_compiled := instruction_sets.load_library()) is not None:
    use(_compiled, instruction_sets.level(_compiled))
