"""Figures of the library as a layer in training, each with its limit: ``python -m benchmarks.layers``."""
