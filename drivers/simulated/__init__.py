"""The simulated cell: a physical world independent of hilcal's effects and model."""
