"""Robot descriptions of the user, corrected where their numbers stand."""
