"""Short-horizon actor-critic (SHAC; Xu et al., ICLR 2022)."""
