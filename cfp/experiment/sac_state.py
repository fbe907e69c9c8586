"""The state of `cfp.agent.sac.CFP` for checkpoints: networks, optimisers, counters, episodes, random generators."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecMonitor

from cfp.agent.replay import ReplayRing
from cfp.agent.sac import CFP
from cfp.envs.vec_env import TorchVecEnv


def model_state_dict(model: CFP) -> dict[str, Any]:
    """All that `CFP` learns and counts but ``num_timesteps``, as tensors and plain values."""
    values = model.logger.name_to_value  # of the row that comes next
    return {name: part.state_dict() for name, part in _parts(model).items()} | {
        "episodes": model._episode_num,
        "updates": model._n_updates,
        "recent": [{key: float(value) for key, value in info.items()} for info in model.ep_info_buffer or ()],
        "successes": [bool(success) for success in model.ep_success_buffer or ()],
        "means": {name: (values[name], count) for name, count in model.logger.name_to_count.items()},
        "environment": _environment_state(model),
        "random": _random_state(model),
    }


def load_model_state_dict(model: CFP, state: dict[str, Any]) -> None:
    """Undo `model_state_dict`."""
    for name, part in _parts(model).items():
        part.load_state_dict(state[name])
    model._episode_num = state["episodes"]
    model._n_updates = state["updates"]
    model.ep_info_buffer = deque(state["recent"], maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(state["successes"], maxlen=model._stats_window_size)
    for name, (mean, count) in state["means"].items():
        model.logger.record_mean(name, mean)
        model.logger.name_to_count[name] = count
    _restore_environment(model, state["environment"])
    _restore_random(model, state["random"])


def _parts(model: CFP) -> dict[str, Any]:
    """What has a state of its own."""
    actor, critic, _ = model.networks()
    optimizers = {"actor_optimizer": actor.optimizer, "critic_optimizer": critic.optimizer}
    parts = {"policy": model.policy, "reward_statistics": model.reward_statistics, **optimizers}
    optional = {"noise": model.noise, "average": model.average}
    return parts | {name: part for name, part in optional.items() if part is not None}


def _environment_state(model: CFP) -> dict[str, Any]:
    """The episodes in progress: the matter, the sums of their rewards, and what the policy sees next."""
    monitor, env = _environments(model)
    return {
        "episodes": env.state_dict(),
        "generators": env.torch_env.generators,
        "returns": torch.from_numpy(monitor.episode_returns.copy()),
        "lengths": torch.from_numpy(monitor.episode_lengths.copy()),
        "observation": torch.from_numpy(np.array(model._last_obs)),
    }


def _restore_environment(model: CFP, state: dict[str, Any]) -> None:
    monitor, env = _environments(model)
    monitor.reset()  # so that later episodes start as they would have
    env.load_state_dict(state["episodes"])
    env.torch_env.generators = state["generators"]
    monitor.episode_returns = state["returns"].numpy().copy()
    monitor.episode_lengths = state["lengths"].numpy().copy()
    model._last_obs = state["observation"].numpy().copy()


def _environments(model: CFP) -> tuple[VecMonitor, TorchVecEnv]:
    monitor = model.get_env()
    assert isinstance(monitor, VecMonitor)
    assert isinstance(monitor.venv, TorchVecEnv)
    return monitor, monitor.venv


def _random_state(model: CFP) -> dict[str, Any]:
    """States of every generator that training draws from: torch's, the replay memory's, the action space's."""
    assert isinstance(model.replay_buffer, ReplayRing)
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "replay": model.replay_buffer.generator.bit_generator.state,
        "actions": model.action_space.np_random.bit_generator.state,
    }
    if model.device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(model.device)
    return state


def _restore_random(model: CFP, state: dict[str, Any]) -> None:
    assert isinstance(model.replay_buffer, ReplayRing)
    torch.set_rng_state(state["torch"])
    model.replay_buffer.generator.bit_generator.state = state["replay"]
    model.action_space.np_random.bit_generator.state = state["actions"]
    if "cuda" in state and model.device.type == "cuda":
        torch.cuda.set_rng_state(state["cuda"], model.device)
