"""The campaign file: readings that never change, revisions that are appended."""
