"""Pictures that fit no memory: the filter of the whole, worked out by rows."""

from nlfilter_torch.streaming.colorize import stream_colorize
from nlfilter_torch.streaming.detail import stream_detail
from nlfilter_torch.streaming.recolor import stream_recolor

__all__ = ["stream_colorize", "stream_detail", "stream_recolor"]
