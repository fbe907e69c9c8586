"""Environments of a run for stable-baselines3."""
