"""Monte-Carlo studies of the program's own mathematics."""
