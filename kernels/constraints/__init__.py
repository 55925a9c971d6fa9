"""Constraint rows, one file for each kind."""
