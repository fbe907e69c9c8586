"""The method: networks, losses and soft actor-critic. Imports nothing of `cfp.experiment`."""
