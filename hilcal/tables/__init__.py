"""Readings of others: the exchange table, mappings, import."""
