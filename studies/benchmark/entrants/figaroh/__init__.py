"""An entrant: `python entrant.py TASK_DIR OUT.json`."""
