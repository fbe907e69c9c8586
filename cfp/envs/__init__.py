"""Environments of a run for stable-baselines3. Imports no networks."""
