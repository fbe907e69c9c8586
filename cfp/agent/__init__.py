"""The networks of the coarse-to-fine policy, and the actions that they choose."""
