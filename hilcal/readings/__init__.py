"""States and readings, every term of a reading's covariance, whitening."""
