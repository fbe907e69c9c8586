"""Watching an algorithm learn."""

from stable_baselines3.common.callbacks import BaseCallback


class EachUpdate(BaseCallback):
    """Calls a function with the scalars of each update."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        self.function(self.model.scalars)
        return True
