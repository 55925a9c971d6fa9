"""Constraint rows, one kind a file."""
