"""Prediction, integration, sleep and moving ground."""
