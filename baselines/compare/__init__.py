"""``python -m baselines.compare``: algorithms, tasks and seeds in one table, with intervals."""
