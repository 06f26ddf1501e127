"""How fast the filter is, beside the minimum cost of its matrix products and other filters.

``python -m benchmarks.speed --out FILE`` measures everything in under ten minutes and writes a JSON file; ``--quick``
checks in seconds that it runs. ``python -m docs.speed FILE`` makes tables and plots from the file.
"""
