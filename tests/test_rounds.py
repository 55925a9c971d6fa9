"""Rounds: heaps solved all at once, against the same method in float64, and against the solution it approaches."""
