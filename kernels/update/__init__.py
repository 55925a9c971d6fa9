"""Prediction, integration, sleeping and moving ground."""
