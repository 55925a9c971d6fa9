"""Diagnostics of the machine, the installation and meshes."""
