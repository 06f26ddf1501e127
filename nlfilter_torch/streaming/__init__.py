"""Pictures that fit no memory: the filter of the whole, worked out by rows."""

from nlfilter_torch.streaming.detail import stream_detail

__all__ = ["stream_detail"]
