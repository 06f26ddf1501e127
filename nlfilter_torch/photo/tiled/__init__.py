"""Pictures larger than memory: the filter of the whole picture, applied in tiles of rows.

Its statistics come from passes over the picture or from a sample of its pixels.
"""
