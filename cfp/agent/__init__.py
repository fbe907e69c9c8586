"""The method: networks, actors, losses, soft actor-critic.

Imports nothing of `cfp.envs`, `cfp.evaluation` or `cfp.experiment`.
"""
