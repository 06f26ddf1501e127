"""Results of the whole package in one file, to compare them before and after a change that must not change them."""

import os

# Sums of several threads may differ in rounding; torch reads this when it is imported.
os.environ["OMP_NUM_THREADS"] = "1"
