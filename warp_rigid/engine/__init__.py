"""The simulator: its arrays, the step, growth of its pools, checkpoints."""
