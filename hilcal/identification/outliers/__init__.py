"""Gross errors among the readings."""
