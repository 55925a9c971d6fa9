"""Joints: rows, and the direct solution of the mechanisms that they form."""
