"""Benchmarks: a table of cases, the measurements of speed and quality, and the comparison with other engines."""
