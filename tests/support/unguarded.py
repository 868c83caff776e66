"""A campaign changed as somebody would who knows SQLite: its guards are back afterwards."""

from contextlib import contextmanager


@contextmanager
def unguarded(db):
    """Let rows be changed that no program of ours changes."""
    kept = db.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for name, _ in kept:
        db.execute(f"DROP TRIGGER {name}")
    yield
    for _, made in kept:
        db.execute(made)
