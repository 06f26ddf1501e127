"""Image files: photographs in memory, TIFF, and pictures read and written a few rows at a time."""

from nlfilter_torch.photo.files.photographs import Photograph, TooLarge, check_output, read_photograph, write_photograph

__all__ = ["Photograph", "TooLarge", "check_output", "read_photograph", "write_photograph"]
