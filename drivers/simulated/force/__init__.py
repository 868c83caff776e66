"""Simulated wrench sensors that stream over a serial line."""
