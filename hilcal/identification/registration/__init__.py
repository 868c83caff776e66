"""Base, target and tracker frames from readings, and cells that are not as described."""
