"""Checks of this computer before a campaign, without any device."""
