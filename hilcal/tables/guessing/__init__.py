"""A mapping proposed for a table whose form is unknown."""
