"""Watching an algorithm learn."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger


class _Rows(BaseCallback):
    def __init__(self):
        super().__init__()
        self.rows, self.since = [], None

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        if self.since not in (None, self.model.num_timesteps):
            self.rows.append(dict(self.model.logger.name_to_value))
        self.since = self.model.num_timesteps

    def _on_training_end(self):
        self._on_rollout_start()


def learn(learner, steps):
    """Take so many further environment steps; return the scalars of each update."""
    callback = _Rows()
    learner.set_logger(Logger(None, []))
    learner.learn(steps, callback, None, reset_num_timesteps=False)
    return callback.rows
