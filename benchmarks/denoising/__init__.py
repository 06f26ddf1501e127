"""Comparison of denoisers on photographs, public sets and repeated patterns: ``python -m benchmarks.denoising``."""
