"""Watching a training, and interrupting it."""

import signal
from contextlib import contextmanager

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from cfp.experiment.callbacks import RunCallback


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


def interrupt():
    """As Ctrl-C does."""
    signal.raise_signal(signal.SIGINT)


@contextmanager
def at_step(step, action):
    """Do something at a step of the run, after everything else that is done there."""
    on_step = RunCallback._on_step

    def act(callback):
        goes_on = on_step(callback)
        if callback.stage.step == step:
            action()
        return goes_on

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunCallback, "_on_step", act)
        yield
