"""The simulated cell: a physical world of its own, apart from hilcal's effects and model."""
