"""Environments of a run for stable-baselines3, and their disturbances. Imports no networks."""
