"""The method: networks, actors, losses, soft actor-critic. Imports nothing of `cfp.experiment` or `cfp.evaluation`."""
