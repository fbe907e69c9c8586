"""Comparisons: a plan of trainings is carried out, and its policies are evaluated on the same episodes."""
