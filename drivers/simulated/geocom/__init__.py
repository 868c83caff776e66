"""A simulated laser station that speaks GeoCOM."""
