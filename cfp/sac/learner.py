"""``cfp-sac``: soft actor-critic with the update rule of the DittoGym reference implementation (paper, Appendix B).

Differences from stable-baselines3's SAC: rewards are normalised by running statistics, the gradient of each tensor is
clipped separately, the gate is penalised, and the random phase is independent of the start of the updates. Options of
`cfp.config.LearningConfig` add what later publications found; the documentation explains them.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecMonitor
from torch import Tensor, nn
from torch.nn import functional as F

from cfp.agent.actor import Actor, NetworkInput, compose, upsample
from cfp.agent.pixels import fill_missing
from cfp.config import Hyperparameters, Preset, SACConfig
from cfp.envs.make import choose_device, make_env
from cfp.envs.vec_env import TorchVecEnv, keeps_tensors
from cfp.errors import ConfigError, NonFiniteError
from cfp.evaluation.page import policy_pictures
from cfp.learner import CoarseToFine, Learner, follow, refines
from cfp.presets import sac_preset
from cfp.resumable import generator_state, restore_generator
from cfp.sac.policies import CFPPolicy, TwinCritic, TwinCriticPolicy
from cfp.sac.replay import ReplayRing
from dittogym.copies import to_device

#: Every scalar that it logs, and what it means.
METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the last training episodes (with action noise)",
    "rollout/length": "their mean length in environment steps",
    "rollout/success": "share of successes among them, where the task defines success",
    "rollout/episodes": "episodes finished in this stage",
    "train/critic_loss": "sum of both critics' mean squared errors, in normalised rewards",
    "train/actor_loss": "mean of alpha log pi - min Q, plus the gate penalty",
    "train/q": "mean of min(Q1, Q2) at the actor's own actions, in normalised rewards",
    "train/q_target": "mean of the critics' regression target",
    "train/entropy": "mean of -log pi of the sampled (in later stages: residual) action, summed over all 2 R R entries",
    "train/reward_mean": "running mean of rewards (of their sums over n_steps), which is subtracted before learning",
    "train/reward_std": "running standard deviation of the same, by which they are divided",
    "train/gate": "mean gate of the residual actor: 0 keeps the coarse action, 1 replaces it",
    "train/gate_penalty": "gate penalty inside the actor loss",
    "train/n_updates": "gradient updates so far in this stage",
    "train/learning_rate": "learning rate of actor and critics",
}
#: Momentum of the running mean and variance of the rewards.
REWARD_MOMENTUM = 0.99
#: Largest gradient norm of each parameter tensor.
MAX_GRAD_NORM = 10.0
#: Of the zeta distribution of the number of steps for which exploration noise is held: exponent, and largest value.
HOLD_EXPONENT, LONGEST_HOLD = 2.0, 16


def clip_each(parameters: Iterable[nn.Parameter], max_norm: float) -> Tensor:
    """Scale the gradient of each parameter tensor separately to a norm of at most ``max_norm``; returns the norms."""
    # The public torch.nn.utils.clip_grad_norm_, called for each tensor, takes ten times as long.
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norms = torch.stack(torch._foreach_norm(gradients))
    torch._foreach_mul_(gradients, list((max_norm / (norms + 1e-6)).clamp(max=1.0).unbind()))
    return norms


class RewardStatistics(nn.Module):
    """Running mean and variance of raw rewards, updated with each batch before it is normalised.

    ``M <- m M + (1 - m) mean(r)``, ``V <- m V + (1 - m) var(r)`` (unbiased), starting at 0 and 1;
    ``normalised r = (r - M) / (sqrt(V) + 1e-8)``.

    Where r is a sum over n steps, some sums end early, at the end of an episode or of the memory. Such a sum has a
    share w of the discount factors ``1 + gamma + ... + gamma^(n-1)``. It counts as ``r / w`` in the statistics, and
    ``w M`` is subtracted from it; subtracting M would penalise the last states of an episode.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros((), dtype=torch.float32))
        self.register_buffer("variance", torch.ones((), dtype=torch.float32))

    @torch.no_grad()
    def forward(self, rewards: Tensor, share: Tensor | float = 1.0) -> Tensor:
        """Update the statistics with raw rewards of any shape and return them normalised; ``share`` is w."""
        whole = rewards / share
        self.mean.lerp_(whole.mean(), 1 - REWARD_MOMENTUM)
        self.variance.lerp_(whole.var(), 1 - REWARD_MOMENTUM)
        return (rewards - share * self.mean) / (self.variance.sqrt() + 1e-8)

    def scalars(self) -> dict[str, Tensor]:
        """Values to log."""
        return {"reward_mean": self.mean, "reward_std": self.variance.sqrt()}


def critic_target(
    actor: Actor,
    target: TwinCritic,
    next_obs: NetworkInput,
    rewards: Tensor,
    not_done: Tensor,
    alpha: Tensor | float,
    discount: Tensor | float,
) -> Tensor:
    """Target of the critics, ``y = r + c d (min Q'(s', a') - alpha log pi(a'|s'))``, (B, 1), without gradient.

    The rewards r are normalised; the continuation flag c (``not_done``) is 1 at a time limit. The ``discount`` d is
    gamma; where r is the discounted sum of n rewards, it is gamma^n, (B, 1).
    """
    with torch.no_grad():
        sample = actor.sample_for_critic(next_obs)
        q_values = smaller_value(target, next_obs, sample.action)
        return rewards + not_done * discount * (q_values - alpha * sample.log_prob[:, None])


def smaller_value(critic: TwinCritic, obs: NetworkInput, action: Tensor) -> Tensor:
    """The smaller one of both critics' values, (B, 1)."""
    return torch.minimum(*critic(obs, action))


def critic_loss(critic: TwinCritic, obs: NetworkInput, actions: Tensor, target_q: Tensor) -> Tensor:
    """Sum of both critics' mean squared errors for actions (B, 2, R, R) or (B, 2 R R)."""
    return torch.stack([F.mse_loss(values, target_q) for values in critic(obs, actions)]).sum()


def actor_loss(
    actor: Actor,
    critic: TwinCritic,
    obs: NetworkInput,
    alpha: Tensor,
    gate_penalty: float,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean of ``alpha log pi - min Q`` plus ``gate_penalty`` times a residual actor's gate, and scalars to log."""
    action, log_prob, gate, _ = actor.sample_for_critic(obs)
    q_values = smaller_value(critic, obs, action)
    loss = (alpha * log_prob[:, None] - q_values).mean()
    scalars = {"q": q_values.detach().mean(), "entropy": -log_prob.detach().mean()}
    if gate is not None:
        penalty = gate_penalty * gate.flatten(1).norm(dim=1).mean() / actor.resolution
        loss = loss + penalty
        scalars |= {"gate": gate.detach().mean(), "gate_penalty": penalty.detach()}
    return loss, scalars


class CellNoise:
    """Gaussian noise for actions (n, 2, R, R), equal in each of ``cells`` x ``cells`` blocks, and held for some steps.

    Independent noise averages out over the body and over time. Noise that is held for a random number of steps is from
    Dabney et al., "Temporally-extended epsilon-greedy exploration" (ICLR 2021), and is used so by FlashSAC (2026); pink
    noise (Eberhard et al., ICLR 2023) is a relative. Another scale for each robot is from Ape-X (Horgan et al., ICLR
    2018).

    Args:
        num_envs: n.
        resolution: R.
        cells: Blocks along each side; at most R.
        scale: Standard deviations of the first and of the last robot; those between are spaced geometrically.
        seed: Of the generator.
    """

    def __init__(
        self, num_envs: int, resolution: int, cells: int, scale: tuple[float, float], seed: int | None
    ) -> None:
        if cells > resolution:
            raise ConfigError(f"noise_cells must be at most {resolution}, the action grid, got {cells}")
        self.block = resolution // cells
        self.scale = np.geomspace(*scale, num_envs, dtype=np.float32)[:, None, None, None]
        self.values = np.zeros((num_envs, 2, cells, cells), np.float32)
        self.left = np.zeros(num_envs, np.int64)
        self.generator = np.random.default_rng(seed)

    def __call__(self) -> Tensor:
        """The noise (n, 2, R, R) of the next step."""
        due = np.flatnonzero(self.left == 0)
        self.values[due] = self.generator.standard_normal((len(due), *self.values.shape[1:]), np.float32)
        self.left[due] = np.minimum(self.generator.zipf(HOLD_EXPONENT, len(due)), LONGEST_HOLD)
        self.left -= 1
        blocks = (self.scale * self.values).repeat(self.block, axis=2).repeat(self.block, axis=3)
        return torch.from_numpy(blocks)

    def state_dict(self) -> dict[str, Any]:
        """Noise, steps left, and state of the generator."""
        generator = self.generator.bit_generator.state
        return {"values": torch.from_numpy(self.values), "left": torch.from_numpy(self.left), "generator": generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self.values, self.left = (state[name].numpy().copy() for name in ("values", "left"))
        self.generator.bit_generator.state = state["generator"]


class CFP(SAC):
    """Soft actor-critic with the update rule of the reference implementation (Huang et al., ICLR 2024, Appendix B).

    It runs on the loop of stable-baselines3's ``SAC``, with these differences: rewards are normalised by running
    statistics, the gradient of each tensor is clipped separately, the gate of a residual actor is penalised, and the
    phase of random actions is independent of the start of the updates. The target of the critics is ``r + c d (min
    Q'(s', a') - alpha log pi(a'|s'))`` with the normalised reward r, the discount d and a flag c that is 0 where the
    task ended the episode; the loss of the actor is the mean of ``alpha log pi - min Q`` plus the gate penalty. In
    stages after the first, the coarse action is sampled anew in every update, and the entropy covers the residual part
    only. `cfp.Hyperparameters` also has options for what later publications found.

    ``predict`` acts by the actor in training, see `trained_actor`. With a `cfp.TorchVecEnv` with ``tensors=True``,
    observations, actions and the replay memory stay on the device, and updates do not wait for it: their scalars, and
    whether they were finite, are read when a row is logged and before anything is saved.

    Args:
        policy: ``"CFPPolicy"``, or `cfp.CFPPolicy` itself.
        env: A vectorised environment with actions (2, R, R) in [-1, 1], such as a `cfp.TorchVecEnv`.
        hyperparameters: Hyperparameters of the stage.
        sac_options: Further arguments of stable-baselines3's ``SAC``, such as ``policy_kwargs``, for instance
            ``{"spec": cfp.ActorSpec(...)}``, ``seed`` and ``device``.

    Raises:
        TypeError: An argument of stable-baselines3 is one of the hyperparameters, is set by CFP, or does not exist.
        cfp.ConfigError: A hyperparameter is out of range.

    Attributes:
        hyperparameters: Hyperparameters of the stage.
        average: The actor with averaged weights; None without ``weight_average``.
        trains_encoder: Whether critics train an encoder that they share with the actor; False where a trained policy
            is refined, which their first updates would change.

    Examples:
        >>> import cfp, dittogym
        >>> env = cfp.TorchVecEnv(dittogym.TorchEnv("run", num_envs=2, particles=300, substeps=10))
        >>> hyperparameters = cfp.Hyperparameters(batch_size=8, buffer_size=64, random_steps=16, update_start=16)
        >>> model = cfp.CFP("CFPPolicy", env, hyperparameters, seed=0).learn(32)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CFPPolicy": CFPPolicy}
    reward_statistics: RewardStatistics
    trains_encoder: bool = True

    def __init__(
        self,
        policy: str | type[TwinCriticPolicy],
        env: GymEnv | str,
        hyperparameters: Hyperparameters = Hyperparameters(),  # noqa: B008  (it is immutable)
        **sac_options: Any,
    ) -> None:
        hyperparameters.check()
        if "n_steps" in sac_options:  # which stable-baselines3 leaves to a replay memory of its own
            raise TypeError(f"n_steps must be one of the hyperparameters, got {sac_options['n_steps']} beside them")
        self.hyperparameters = own = hyperparameters
        spec = (sac_options.get("policy_kwargs") or {}).get("spec")
        # As critics take them, if those are smaller than the ones that are carried out.
        size = spec.critic_size if spec and spec.critic_size < spec.action_size else None
        replay = {"seed": sac_options.get("seed"), "action_size": size, "n_steps": own.n_steps}
        rate = own.learning_rate
        super().__init__(
            policy,
            env,
            rate if own.final_rate == 1 else LinearSchedule(rate, own.final_rate * rate, 1.0),
            own.buffer_size,
            own.update_start,
            own.batch_size,
            own.tau,
            own.gamma,
            gradient_steps=own.gradient_steps,
            action_noise=None,  # the actor's own, and `CellNoise`
            replay_buffer_class=ReplayRing,
            replay_buffer_kwargs=replay | {"gamma": own.gamma},
            ent_coef=own.alpha,
            target_update_interval=1,
            **sac_options,
        )

    def _setup_model(self) -> None:
        self.replay_buffer_kwargs["tensors"] = self.on_device
        super()._setup_model()
        own = self.hyperparameters
        self.reward_statistics = RewardStatistics().to(self.device)
        self._unread: list[tuple[list[str], Tensor]] = []  # names and scalars of each update
        self._are_finite = torch.ones((), dtype=torch.bool, device=self.device)  # these updates
        self.noise = None
        if own.noise_cells:
            resolution = self.networks()[0].resolution
            self.noise = CellNoise(self.n_envs, resolution, own.noise_cells, own.noise_scale, self.seed)
        self.restart_average()

    @property
    def on_device(self) -> bool:
        """Whether observations, actions and transitions stay on the device."""
        return keeps_tensors(self.env)

    def restart_average(self) -> None:
        """Let the average of the actor's weights begin with those it has now."""
        decay, actor = self.hyperparameters.weight_average, self.networks()[0]
        self.average = copy.deepcopy(actor).requires_grad_(False) if decay else None

    @property
    def trained_actor(self) -> Actor:
        """The actor with averaged weights, or the one in training if there is no average.

        Raises:
            cfp.NonFiniteError: One of the last updates was not finite.
        """
        self.read_updates()  # so that weights that are not finite are not saved
        return self.networks()[0] if self.average is None else self.average

    def networks(self) -> tuple[Actor, TwinCritic, TwinCritic]:
        """Actor, critics and target critics."""
        assert isinstance(self.policy, TwinCriticPolicy)
        return self.policy.networks()

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Perform ``gradient_steps`` updates, each with ``batch_size`` transitions.

        Raises:
            NonFiniteError: A loss is not finite; the optimiser step is not taken. With ``on_device``, `read_updates`
                raises it later.
        """
        assert self.replay_buffer is not None
        actor, critic, _ = self.networks()
        self.policy.set_training_mode(True)
        self._update_learning_rate([actor.optimizer, critic.optimizer])
        for _ in range(gradient_steps):
            scalars = self.update(self.replay_buffer.sample(batch_size))
            self._n_updates += 1
            self._unread.append((list(scalars), torch.stack(tuple(scalars.values()))))
        if not self.on_device:
            self.read_updates()
        self.logger.record("train/n_updates", self._n_updates)

    def read_updates(self) -> None:
        """Record the scalars of all updates since the last call, for which it waits for the device once.

        Raises:
            NonFiniteError: One of the updates was not finite.
        """
        unread, self._unread = self._unread, []
        if not unread:
            return
        *values, are_finite = torch.cat([*(each for _, each in unread), self._are_finite[None]]).tolist()
        if not are_finite:
            raise NonFiniteError(
                f"a loss or its gradient is not finite in one of the updates {self._n_updates + 1 - len(unread)} to "
                f"{self._n_updates} ({self.num_timesteps} environment steps into the stage)"
            )
        for name, value in zip((name for names, _ in unread for name in names), values, strict=True):
            self.logger.record_mean(f"train/{name}", value)

    def dump_logs(self) -> None:
        """Write a row, see stable-baselines3."""
        self.read_updates()
        super().dump_logs()

    def update(self, batch: ReplayBufferSamples) -> dict[str, Tensor]:
        """Perform one update of critics, actor and averages.

        Args:
            batch: Transitions, as the replay buffer of stable-baselines3 samples them.

        Returns:
            Scalars by the names of the logs without ``train/``, such as ``critic_loss`` and ``entropy``.

        Raises:
            cfp.NonFiniteError: A loss or its gradient is not finite; the optimiser's step is not taken. With tensors on
                the device, the error comes later, when a row is logged.
        """
        assert isinstance(self.policy, TwinCriticPolicy)
        actor, critic, target = self.networks()
        obs = self.policy.encode(batch.observations)
        if not self.trains_encoder:
            obs = obs.detach()
        with torch.no_grad():
            next_obs = self.policy.encode(batch.next_observations)
        discount: Tensor | float = self.gamma
        share: Tensor | float = 1.0
        if batch.discounts is not None:  # rewards are sums over several steps, of which some end early
            discount = batch.discounts
            share = (1 - discount) / (1 - self.gamma**self.hyperparameters.n_steps)
        rewards, not_done = self.reward_statistics(batch.rewards, share), 1 - batch.dones
        target_q = critic_target(actor, target, next_obs, rewards, not_done, self.ent_coef_tensor, discount)
        loss = critic_loss(critic, obs, batch.actions, target_q)
        self._descend(loss, critic.optimizer, "critic")
        scalars = {"critic_loss": loss.detach(), "q_target": target_q.mean()}
        if self.num_timesteps >= self.hyperparameters.actor_start:
            critic.requires_grad_(False)  # avoids weight gradients of the critics, which would be discarded
            penalty = self.hyperparameters.gate_penalty
            loss, of_actor = actor_loss(actor, critic, obs.detach(), self.ent_coef_tensor, penalty)
            self._descend(loss, actor.optimizer, "actor")
            critic.requires_grad_(True)
            scalars |= of_actor | {"actor_loss": loss.detach()}
        if self.average is not None:
            follow(self.average, actor, self.hyperparameters.weight_average)
        follow(target, critic, 1 - self.tau)
        return scalars | self.reward_statistics.scalars()

    def _descend(self, loss: Tensor, optimizer: torch.optim.Optimizer, name: str) -> None:
        optimizer.zero_grad()
        loss.backward()
        norms = clip_each(optimizer.param_groups[0]["params"], MAX_GRAD_NORM)
        are_finite = torch.isfinite(loss) & torch.isfinite(norms).all()
        if self.on_device:
            self._are_finite &= are_finite
        elif not are_finite:
            raise NonFiniteError(
                f"the {name} loss {loss.item()} or its gradient is not finite at update {self._n_updates + 1} "
                f"({self.num_timesteps} environment steps into the stage)"
            )
        optimizer.step()

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions to execute, and their form in the replay buffer."""
        assert isinstance(self.replay_buffer, ReplayRing)
        size = self.replay_buffer.action_size
        random_steps = self.hyperparameters.random_steps
        if self.num_timesteps < random_steps:
            # stable-baselines3 ends its random phase where updates start; here the two are independent.
            return self._on_action_grid(*super()._sample_action(random_steps, action_noise, n_envs), size)
        if self.on_device:  # the environment checks the actions
            return self._act(size)
        # `predict` would fill the images of `_last_obs`, which are filled, once more.
        if size is not None or self.noise is not None or self._fills_images:
            actions, stored = (part.cpu().numpy() for part in self._act(size))
        else:
            actions, stored = super()._sample_action(0, action_noise, n_envs)
        finite = np.isfinite(actions).reshape(len(actions), -1).all(axis=1)
        if not finite.all():
            raise NonFiniteError(
                f"the action of environment {int(np.argmin(finite))} is not finite at step {self.num_timesteps} of the "
                "stage; nothing of this step was stored"
            )
        return actions, stored

    def _on_action_grid(
        self, actions: np.ndarray, stored: np.ndarray, stored_size: int | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coarsen uniform actions to the action grid of the stage; independent pixels of a patch would average out."""
        if not isinstance(self.policy, CFPPolicy):
            return actions, stored
        grid, size = self.networks()[0].resolution, self.policy.spec.action_size
        if grid == size:
            return actions, stored
        corner = torch.as_tensor(stored[..., :grid, :grid], dtype=torch.float32)
        actions, stored = (
            upsample(corner, each, self.policy.spec.interpolation).numpy() for each in (size, stored_size or size)
        )
        return actions, stored

    @torch.no_grad()
    def _act(self, stored_size: int | None) -> tuple[Any, Any]:
        """Act as ``predict`` does, with exploration noise; actions, and those to store of another size, as tensors."""
        assert self._last_obs is not None
        self.policy.set_training_mode(False)
        seen: Any = self._last_obs
        observation = torch.as_tensor(seen, device=self.device)
        actor = self.networks()[0]
        outputs = actor.outputs(observation)
        if self.noise is not None:
            noise = to_device(self.noise().numpy(), outputs.mean.device)
            outputs = outputs._replace(mean=outputs.mean + noise)
        sample = actor.act(outputs)
        if stored_size is None or not isinstance(self.policy, CFPPolicy):
            return sample.action, sample.action
        return sample.action, compose(sample.parts, stored_size, self.policy.spec.interpolation)

    @property
    def _fills_images(self) -> bool:
        return isinstance(self.policy, CFPPolicy) and self.policy.spec.fill_missing

    def _prepared(self, observation: Any) -> Any:
        """Images of the environment as the networks, and the replay memory, get them."""
        if not self._fills_images:
            return observation
        filled = fill_missing(torch.as_tensor(observation))
        return filled if isinstance(observation, Tensor) else filled.numpy()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        resets = reset_num_timesteps or self._last_obs is None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if resets:
            assert isinstance(self.replay_buffer, ReplayRing)
            self.replay_buffer.cut()
            self._last_obs = self._prepared(self._last_obs)
        return result

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: Any,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # stable-baselines3's own would store images as they are beneath a VecNormalize, not as networks get them.
        new_obs = self._prepared(new_obs)
        next_obs, ended = new_obs, np.flatnonzero(dones)
        if len(ended):
            finals = self._prepared(np.stack([infos[index]["terminal_observation"] for index in ended]))
            if self.on_device:
                next_obs = new_obs.index_copy(0, to_device(ended, self.device), to_device(finals, self.device))
            else:
                next_obs = new_obs.copy()
                next_obs[ended] = finals
        replay_buffer.add(self._last_obs, next_obs, buffer_action, reward, dones, infos)  # type: ignore[arg-type]
        self._last_obs = new_obs

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        modules, tensors = super()._get_torch_save_params()
        return [*modules, "reward_statistics", *([] if self.average is None else ["average"])], tensors

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "reward_statistics", "noise", "average", "_unread", "_are_finite"]

    def state_dict(self) -> dict[str, Any]:
        """All that it learns and counts but ``num_timesteps`` and the replay buffer, as tensors and plain values."""
        self.read_updates()
        values = self.logger.name_to_value  # of the row that comes next
        monitor, env = self._environments()
        return {name: part.state_dict() for name, part in self._parts().items()} | {
            "episodes": self._episode_num,
            "updates": self._n_updates,
            "recent": [{key: float(value) for key, value in info.items()} for info in self.ep_info_buffer or ()],
            "successes": [bool(success) for success in self.ep_success_buffer or ()],
            "means": {name: (values[name], count) for name, count in self.logger.name_to_count.items()},
            "environment": {  # the episodes in progress
                "episodes": env.state_dict(),
                "generators": env.torch_env.generators,
                "returns": torch.from_numpy(monitor.episode_returns.copy()),
                "lengths": torch.from_numpy(monitor.episode_lengths.copy()),
                "observation": torch.as_tensor(self._last_obs).cpu().clone(),
            },
            "random": {name: generator_state(generator) for name, generator in self._generators().items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the ``state`` of `state_dict`."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        if state["actor_optimizer"]["state"]:  # in a stage that was prolonged an actor that learns goes on to learn
            self.hyperparameters = replace(self.hyperparameters, actor_start=0)
        self._episode_num, self._n_updates = state["episodes"], state["updates"]
        self.ep_info_buffer = deque(state["recent"], maxlen=self._stats_window_size)
        self.ep_success_buffer = deque(state["successes"], maxlen=self._stats_window_size)
        for name, (mean, count) in state["means"].items():
            self.logger.record_mean(name, mean)
            self.logger.name_to_count[name] = count
        monitor, env = self._environments()
        monitor.reset()  # so that later episodes start as they would have
        episodes, generators = state["environment"], state["random"]
        env.load_state_dict(episodes["episodes"])
        env.torch_env.generators = episodes["generators"]
        monitor.episode_returns = episodes["returns"].numpy().copy()
        monitor.episode_lengths = episodes["lengths"].numpy().copy()
        observation: Any = episodes["observation"].clone()
        self._last_obs = observation.to(self.device) if self.on_device else observation.numpy()
        for name, generator in self._generators().items():
            restore_generator(generator, generators.get(name, generators["torch"]))

    def _parts(self) -> dict[str, Any]:
        """What has a state of its own."""
        actor, critic, _ = self.networks()
        optimizers = {"actor_optimizer": actor.optimizer, "critic_optimizer": critic.optimizer}
        parts = {"policy": self.policy, "reward_statistics": self.reward_statistics, **optimizers}
        optional = {"noise": self.noise, "average": self.average}
        return parts | {name: part for name, part in optional.items() if part is not None}

    def _environments(self) -> tuple[VecMonitor, TorchVecEnv]:
        monitor = self.get_env()
        assert isinstance(monitor, VecMonitor) and isinstance(monitor.venv, TorchVecEnv)
        return monitor, monitor.venv

    def _generators(self) -> dict[str, np.random.Generator | torch.Generator]:
        """Those that training draws from: torch's, the replay memory's, and the action space's."""
        assert isinstance(self.replay_buffer, ReplayRing)
        own = {"replay": self.replay_buffer.generator, "actions": self.action_space.np_random}
        if self.device.type == "cuda":
            own["cuda"] = torch.cuda.default_generators[torch.empty(0, device=self.device).device.index]
        return {"torch": torch.default_generator, **own}


class SACLearner(CFP, Learner):
    """Soft actor-critic with whatever networks, as the learner of a run."""

    presets = get_args(Preset)

    @classmethod
    def make(
        cls, config: Any, stage: int, folder: Path, env: VecMonitor, policy: type[TwinCriticPolicy], networks: Any
    ) -> SACLearner:
        """The learner at the beginning of a stage, with a policy that has ``networks`` as its options."""
        options = {"policy_kwargs": networks, "seed": config.seed, "stats_window_size": max(10, env.num_envs)}
        own = cls.stage_hyperparameters(config, stage, folder)
        learner = cls(policy, env, own, device=choose_device(config.device), **options)
        learner.config, learner.stage = config, stage
        learner.set_logger(Logger(None, []))
        return learner

    @classmethod
    def stage_hyperparameters(cls, config: Any, stage: int, folder: Path) -> Hyperparameters:
        """Hyperparameters of a stage."""
        own: Hyperparameters = config.hyperparameters(stage)
        return own

    @property
    def steps_without_change(self) -> int:
        """Environment steps at the beginning of the stage before actor updates (the small encoder learns earlier)."""
        return max(self.hyperparameters.actor_start, self.hyperparameters.update_start)

    @classmethod
    def warnings(cls, config: Any, folder: Path, first_stage: int) -> list[str]:
        """Stages that end before they act by their policy, or before they learn."""
        lines = []
        for stage in range(first_stage, len(config.ends()) + 1):
            steps, own = config.stage_steps(stage), cls.stage_hyperparameters(config, stage, folder)
            if steps <= own.random_steps:
                lines.append(f"stage {stage}: all its {steps:,} steps are random (--random-steps {own.random_steps})")
            elif steps <= own.update_start:
                lines.append(f"stage {stage}: no update in its {steps:,} steps (--update-start {own.update_start})")
        return lines

    def log_row(self) -> None:
        """Record scalars of the updates and of the last episodes."""
        self.read_updates()
        episodes, record = self.ep_info_buffer or (), self.logger.record
        for name, key in (("return", "r"), ("length", "l")):
            record(f"rollout/{name}", float(np.mean([float(each[key]) for each in episodes])) if episodes else None)
        record("rollout/episodes", self._episode_num)
        if self.ep_success_buffer:
            record("rollout/success", float(np.mean(self.ep_success_buffer)))


class CFPSAC(SACLearner, CoarseToFine):
    """Learns the stages of the coarse-to-fine policy from rewards alone, as the paper does."""

    config: SACConfig

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """Default options for a task, see `cfp.preset`."""
        return sac_preset(task, name)

    @classmethod
    def stage_hyperparameters(cls, config: SACConfig, stage: int, folder: Path) -> Hyperparameters:
        """Hyperparameters of a stage; a policy that is refined does not act at random."""
        own = config.hyperparameters(stage)
        return replace(own, random_steps=0) if refines(config, folder, stage) else own

    @classmethod
    def create(cls, config: SACConfig, stage: int, folder: Path) -> CFPSAC:
        """Networks, replay memory and environment of a stage."""
        tensors = choose_device(config.device) != "cpu"
        size, conditions = config.action_size(stage), config.conditions(stage)
        env = make_env(config, size, None, config.max_episode_steps, tensors, conditions=conditions)
        spec = config.actor_spec(stage)
        learner = cls.make(config, stage, folder, env, CFPPolicy, {"spec": spec})
        assert isinstance(learner, CFPSAC)
        learner.spec = spec
        learner.starts_trained = cls.warm_start(config, stage, folder, learner.networks()[0])
        learner.restart_average()
        learner.trains_encoder = not refines(config, folder, stage)
        return learner

    def images(self) -> dict[str, np.ndarray]:
        """What the actor does with the observation of the first robot."""
        seen: Any = self._last_obs
        observation = torch.as_tensor(seen[:1], device=self.device)
        return policy_pictures(self.trained_actor, observation)
