"""What several algorithms share: the training protocol, episodes, rollouts and reference policies."""
