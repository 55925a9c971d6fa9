"""Builders of stacks, piles and meshes, shared by scenes, benchmarks, validation and tests."""
