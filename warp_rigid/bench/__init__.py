"""Benchmarks: scenes as data, what is measured of them, and other engines beside ours."""
