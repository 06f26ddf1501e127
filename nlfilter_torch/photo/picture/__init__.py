"""A picture as the source of an edit: its pixels in memory, sizes, colours, limits and painted strokes."""
