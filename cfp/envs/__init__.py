"""Environments for training: the `VecEnv` adapter and the disturbances of robustness tests."""
