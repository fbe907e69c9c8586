"""Shared by several algorithms: options, policies and rollouts; reference policies, and the single stages of CFP."""
