"""The inner part of an image: that whose values are needed."""

Inner = tuple[slice, slice]  # rows and columns
EVERYWHERE: Inner = (slice(None), slice(None))
