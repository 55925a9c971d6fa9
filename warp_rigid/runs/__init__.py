"""Runs of scenes: assignments, recordings, events and verdicts."""
