"""Reports: the story as data, in rerun, as pictures."""
