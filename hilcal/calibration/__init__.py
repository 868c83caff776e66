"""Use of an identified model: predicted poses of the tool, and corrected joint values."""
