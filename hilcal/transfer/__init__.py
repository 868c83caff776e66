"""Between campaigns: what has changed on an arm, fleets of arms."""
