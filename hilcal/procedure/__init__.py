"""The calibration procedure: each step follows from the contents of the campaign files."""
