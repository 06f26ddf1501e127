"""The denoiser: a small network that computes guide and sliders for a filter of similar pixels."""
