"""A global, data-adapted image filter as a differentiable object.

Talebi and Milanfar, "Nonlocal Image Editing", IEEE Transactions on Image Processing 23(10), 2014.

Public names, which ``__init__.pyi`` lists, are imported when they are first used, so that commands that need no filter
do not wait for torch.
"""

from lazy_loader import attach_stub

from nlfilter_torch.version import __version__ as __version__

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
