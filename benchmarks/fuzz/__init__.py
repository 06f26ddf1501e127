"""Random operators, pictures and calls, checked against the library's promises: ``python -m benchmarks.fuzz``."""
