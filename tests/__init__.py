"""Tests of nlfilter_torch. A package, so that tests and benchmarks share one reference and one set of images."""
