"""How fast the filter is, against the least that its matrix products cost and against other filters.

``python -m benchmarks.speed --out FILE`` measures everything into a JSON file in under ten minutes; ``--quick`` shows
in seconds that it runs. ``python -m benchmarks.report FILE`` makes the tables and plots from it.
"""
