"""A campaign: its file opened, its revisions, changes of its model."""
