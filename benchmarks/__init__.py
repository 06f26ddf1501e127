"""Executable claims: each module prints what it measures, ``python -m benchmarks.<name>`` from the root."""
