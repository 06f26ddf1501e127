"""Pictures larger than memory: the filter of the whole picture, applied in tiles of rows."""

from nlfilter_torch.tiled.stream import stream_colorize, stream_detail, stream_recolor

__all__ = ["stream_colorize", "stream_detail", "stream_recolor"]
