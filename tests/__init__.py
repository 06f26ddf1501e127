"""Tests of nlfilter_torch; a package, so that tests and benchmarks share one reference and one set of pictures."""
