"""Programs that run other engines, each in a Python environment that needs only NumPy and the engine."""
