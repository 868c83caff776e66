"""The benchmark of hidden effects: tasks, their truth, and how results are scored."""
