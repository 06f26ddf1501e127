"""Options of a filter whose detail layers exclude shading, for edits of brightness. Imports no torch: help reads it."""

LEVELS = 20.0  # photometric bandwidth, in grey levels
NEAR = 1 / 12  # spatial bandwidth, as a fraction of the short side; excludes shading from the detail layers
LANDMARKS = 300
