"""The learner ``analytic``: the coarse-to-fine policy, trained by gradients through the simulation."""
