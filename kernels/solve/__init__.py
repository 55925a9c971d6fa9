"""Solvers: restitution, contact impulses, shock propagation, push-out."""
