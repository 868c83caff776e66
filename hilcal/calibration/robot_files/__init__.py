"""Robot descriptions of the user, corrected in place."""
