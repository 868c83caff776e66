"""Where a model fails, which effect is missing, and whether it is adequate."""
