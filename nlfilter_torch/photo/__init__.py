"""The application: edits of photographs, files, the editor and the command line, built on the library.

Public names, which ``__init__.pyi`` lists, are imported when they are first used.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
