"""``cfp-analytic``: the coarse-to-fine policy, learned by gradients through the simulation."""
