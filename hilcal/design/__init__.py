"""Which states to measure, and in which order."""
