"""Pictures larger than memory: the filter of the whole picture, applied in tiles of rows."""

from nlfilter_torch.tiled.colorize import stream_colorize
from nlfilter_torch.tiled.detail import stream_detail
from nlfilter_torch.tiled.recolor import stream_recolor

__all__ = ["stream_colorize", "stream_detail", "stream_recolor"]
