"""Checks of a machine, an installation and a mesh."""
