"""Device functions that all stages use."""
