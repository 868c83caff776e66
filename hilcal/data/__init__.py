"""States and readings, covariances, the exchange table and the campaign file."""
