"""Running scenes: assignments, recordings, checkpoints, events and verdicts."""
