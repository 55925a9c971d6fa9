"""The contact graph: supports, levels, islands and colours."""
