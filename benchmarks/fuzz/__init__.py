"""Random operators, pictures and calls, and what the library promises of each: ``python -m benchmarks.fuzz``."""
