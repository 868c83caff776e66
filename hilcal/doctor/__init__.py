"""What stands between an operator and a campaign on this computer: found without any device."""
