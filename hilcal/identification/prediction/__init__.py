"""Predictions with their uncertainty, errors at poses that were not fitted, and validation."""
