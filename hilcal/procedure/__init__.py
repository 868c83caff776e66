"""A whole calibration, step by step: each step is chosen from what the campaign's files hold."""
