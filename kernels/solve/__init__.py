"""Solver stages: restitution, Gauss-Seidel sweeps, shock propagation, line search, push-out."""
