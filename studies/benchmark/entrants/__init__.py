"""Who enters the benchmark: a folder each, the runner and the tables."""
