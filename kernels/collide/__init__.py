"""Broad phase, distances, surface samples and contact detection."""
