"""Physical effects: one file each, the protocol, and the catalogue."""
