"""Scenes and shapes: what is simulated, as plain data."""
