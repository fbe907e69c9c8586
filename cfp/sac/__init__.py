"""``cfp-sac``: the coarse-to-fine policy, learned from rewards alone by soft actor-critic, as in the paper."""
