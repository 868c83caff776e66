"""Measuring a campaign: device protocols, limits, settling, averaging, the run itself."""
