"""Laws in readable form for what no effect of the catalogue explains."""
