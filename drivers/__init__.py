"""Drivers of real devices, and the simulated cell."""
