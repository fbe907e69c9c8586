"""How far gradients through a task reach: ``python -m baselines.gradlab``."""
