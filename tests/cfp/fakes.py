"""A tiny environment with the interface of `dittogym.TorchEnv`, for tests of what lies above the physics."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from torchmpm import tree


@tree.register
@dataclass(frozen=True)
class FakeState:
    """A number per element that actions push up and down, and the steps taken."""

    height: Tensor
    steps: Tensor

    @property
    def x(self):
        """Particles of a robot that is whole after an even number of steps, and has lost a fifth after an odd one."""
        whole = torch.tensor([[0.5, 0.5], [0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]]) / 128
        lost = torch.tensor([[0.1, 0.0], *[[0.0, 0.0]] * 4])
        return whole + (self.steps % 2)[:, None, None] * lost

    @property
    def origin(self):
        """Corners of the windows."""
        return torch.zeros(len(self.steps), 2)


class FakeEnv:
    """Reward 1 - |height - 0.5|; height moves by ``push`` times the mean action.

    Args:
        num_envs: B.
        resolution: R.
        horizon: Steps until the time limit.
        end_above: An element terminates above this height.
        start: Height of element i after a reset with seed s is start + s / 100 + i / 10.
        push: How far the largest action moves it.
        faults: Step (per element) -> "reward" or "state": what is not finite then, in element 0.
    """

    def __init__(self, num_envs=2, resolution=8, horizon=5, end_above=10.0, start=0.0, push=0.1, faults=None):
        self.num_envs, self.action_resolution = num_envs, resolution
        self.spec = SimpleNamespace(horizon=horizon, split_limit=1.4)
        self.model = SimpleNamespace(num_robot_particles=5)
        self.end_above, self.faults, self.device = end_above, faults or {}, torch.device("cpu")
        self.start, self.push = start, push
        self.observation_shape, self.action_shape = (3, 64, 64), (2, resolution, resolution)
        self.first = start + torch.arange(num_envs) / 10.0
        self.env_state = FakeState(self.first.clone(), torch.zeros(num_envs, dtype=torch.int64))
        self.actions, self.generators = [], {}
        self._image = torch.zeros(num_envs, 3, 64, 64, dtype=torch.uint8)

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.first = self.start + seed / 100.0 + torch.arange(self.num_envs) / 10.0
        mask = (options or {}).get("reset_mask", torch.ones(self.num_envs, dtype=torch.bool))
        state = self.env_state
        self.env_state = FakeState(
            torch.where(mask, self.first, state.height), torch.where(mask, torch.zeros_like(state.steps), state.steps)
        )
        return self._observe(), {"finite": torch.ones(self.num_envs, dtype=torch.bool)}

    def step(self, action):
        self.actions.append(action.clone())
        state = self.env_state
        height = state.height + self.push * action.mean((1, 2, 3))
        self.env_state = replace(state, height=height, steps=state.steps + 1)
        reward = 1 - (height - 0.5).abs()
        finite = torch.ones(self.num_envs, dtype=torch.bool)
        fault = self.faults.get(int(self.env_state.steps[0]))
        if fault == "reward":
            reward[0] = float("nan")
        if fault == "state":
            finite[0] = False
        info = {
            "finite": finite,
            "is_success": height > 0.4,
            "split": 4 * height,
            "reward_terms": {"near": reward - 1, "alive": reward * 0 + 1},
        }
        terminated, truncated = (height > self.end_above) | ~finite, self.env_state.steps >= self.spec.horizon
        return self._observe(), reward, terminated, truncated, info

    @property
    def state(self):
        return self.env_state

    def render(self, index=0):
        return np.full((512, 512, 3), index, np.uint8)

    def _observe(self):
        # One buffer, overwritten at every call, as an environment is free to do.
        code = (self.env_state.height * 100 + 50).clamp(0, 255).to(torch.uint8)
        self._image[:, 0] = code[:, None, None]
        self._image[:, 1] = self.env_state.steps.to(torch.uint8)[:, None, None]
        return self._image
