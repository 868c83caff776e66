"""Comparison of campaigns: changes of an arm, fleets of arms."""
