"""Robot and effects: static equilibrium, observation, Jacobians."""
