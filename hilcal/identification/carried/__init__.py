"""What a campaign carries to the next one, and later readings of the same arm."""
