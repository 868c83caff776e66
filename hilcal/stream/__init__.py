"""Identification of readings that do not fit into memory."""
