"""Benchmarks that check claims: ``python -m benchmarks.<name>``, run from the root, prints what a module measures."""
