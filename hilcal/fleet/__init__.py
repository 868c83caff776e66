"""Many campaigns of many arms: what arms of a type have in common, and which differ."""
