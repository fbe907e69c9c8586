"""Shared by several algorithms: the training protocol, episodes, rollouts and reference policies."""
