"""The filter whose details are without shading, for edits of brightness. Imports no torch, as help needs it."""

LEVELS = 20.0  # photometric bandwidth, in grey levels
NEAR = 1 / 12  # spatial bandwidth, as a share of the short side: how far shading is compared, so that it is no detail
LANDMARKS = 300
