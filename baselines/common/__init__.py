"""Shared by several algorithms: options, policies and rollouts; reference policies."""
