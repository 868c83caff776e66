"""Laws in readable form for misfit that no effect of the catalogue explains."""
