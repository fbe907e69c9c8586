"""``cfp-analytic``: windows of simulation, a step on their actions, regression of the actor, and a critic.

The policy sees the image only. The critic sees the state of the simulation, and is needed in training only.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from cfp.agent.actor import Actor, build_actor
from cfp.analytic.critic import Critic, StateFeatures, check_norms, descend, make_adam, mlp
from cfp.analytic.window import WINDOW_METRICS, Window, WindowCollector, reward_warnings, short_horizon_loss
from cfp.config import AnalyticConfig, of_stage
from cfp.envs.make import choose_device, make_env, seeded
from cfp.errors import NonFiniteError
from cfp.evaluation.page import policy_pictures
from cfp.learner import CoarseToFine, NetworksPolicy, UpdateLoop, follow, linear_decay, refines
from cfp.presets import analytic_preset
from cfp.resumable import Resumable, compress, decompress

#: Every scalar that ``CFPAnalytic.update`` logs, and what it means.
METRICS: dict[str, str] = {
    **WINDOW_METRICS,
    "train/critic_loss": "mean squared error of the critic in the last of its updates",
    "train/regression_loss": "mean squared error of mean actions and gate logits in the last step of the regression",
    "train/action_step": "root mean square of the step on the actions",
    "train/learning_rate": "Adam's step size",
    "train/limited": "gradients of single actions that were shortened as outliers",
}
#: Training stops after so many windows in a row without any gradient.
MOST_EMPTY_WINDOWS = 10
#: Gradients of single actions longer than this many running medians are shortened to it.
OUTLIER = 3.0
#: Latest norms that the median is taken of, or those of a window if they are more.
HISTORY = 2_000
#: Largest magnitude of an improved mean, whose tanh is 0.987, and of an improved gate logit before its bias.
BOUND = 2.5
#: Of Adam in the regression.
REGRESSION_BETAS = (0.9, 0.95)


class ActionStep(Resumable):
    """The first half of the update: better actions, by the gradient of a window (PODS; Mora et al., ICML 2021).

    PODS takes Gauss-Newton or plain gradient steps on the actions of whole trajectories. Here the gradient covers a
    window that ends in a critic's value, its outliers are limited, and the step, which is taken before tanh, has a
    given size.

    Attributes:
        norms: Latest finite norms of single actions' gradients.
        limited: How many gradients were shortened so far.
    """

    values = ("norms", "limited")

    def __init__(self) -> None:
        self.norms: list[float] = []
        self.limited = 0

    @torch.no_grad()
    def __call__(self, locations: Tensor, gradients: Tensor, size: float) -> Tensor:
        """Improved locations of the actions, see `cfp.agent.actor.Outputs.location`.

        Args:
            locations: (T, B, C, R, R).
            gradients: Of the loss, with the same shape and finite.
            size: Root mean square of the step.
        """
        gradients = gradients.double()  # squares of outliers overflow in single precision
        norms = gradients.flatten(2).norm(dim=2)
        found = norms.cpu().numpy()
        # Whole windows: norms change along them, and with many robots the latest would be of its last steps alone.
        self.norms = [*self.norms, *found[found > 0].tolist()][-max(HISTORY, found.size) :]
        if not self.norms:
            return locations.clone()
        largest = OUTLIER * float(np.median(self.norms))
        self.limited += int((found > largest).sum())
        gradients = gradients * (largest / norms.clamp_min(largest))[..., None, None, None]
        step = size * gradients / gradients.square().mean().sqrt().clamp_min(torch.finfo(torch.double).tiny)
        return (locations - step.to(locations)).clamp(-BOUND, BOUND)


class ImageMemory(Resumable):
    """The latest pairs of an image (3, 64, 64) uint8 and the location (C, R, R) of the action to take there.

    Args:
        capacity: Number of pairs; older ones are overwritten.
        example: An image and a location, for shapes, types and device.
    """

    values = ("locations", "count")

    def __init__(self, capacity: int, example: tuple[Tensor, Tensor]) -> None:
        self.images, self.locations = (part.new_zeros(capacity, *part.shape) for part in example)
        self.count = 0

    def add(self, images: Tensor, locations: Tensor) -> None:
        """Store a batch of pairs."""
        index = torch.arange(self.count, self.count + len(images), device=images.device) % len(self.images)
        self.images[index], self.locations[index] = images, locations
        self.count += len(images)

    def sample(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A random batch of pairs, with replacement."""
        stored = min(self.count, len(self.images))
        index = torch.randint(stored, (size,), generator=generator, device=generator.device).to(self.images.device)
        return self.images[index], self.locations[index]

    def state_dict(self) -> dict[str, Any]:
        """All pairs, the images compressed."""
        return super().state_dict() | {"images": compress(self.images)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        super().load_state_dict(state)
        self.images = decompress(state["images"], self.images.shape[1:]).to(self.images.device)


class Regression(Resumable):
    """The second half of the update: the actor learns the improved actions from images (PODS).

    As in D.Va (NeurIPS 2025) no gradient passes through the rendering: images are inputs only. The running average of
    the weights is the policy.

    Args:
        actor: Composed or plain; its standard deviation is not trained.
        learning_rate: Adam's step size.
        decay: Of the exponential average of the weights.
        max_grad_norm: Largest norm of a gradient.
    """

    parts = ("actor", "average", "adam")

    def __init__(self, actor: Actor, learning_rate: float, decay: float, max_grad_norm: float) -> None:
        self.actor, self.decay, self.max_grad_norm = actor, decay, max_grad_norm
        self.average = copy.deepcopy(actor).requires_grad_(False)
        self.adam = make_adam(actor.trainable_parameters(), learning_rate, REGRESSION_BETAS)

    def update(self, images: Tensor, locations: Tensor, learning_rate: float) -> tuple[Tensor, Tensor]:
        """Take one step of Adam towards the ``locations`` of actions for ``images``.

        Returns:
            The mean squared error, and the norm of its gradient, for `check_norms`.
        """
        self.adam.param_groups[0]["lr"] = learning_rate
        self.adam.zero_grad()
        loss = F.mse_loss(self.actor.outputs(images, deterministic=True).location, locations)
        loss.backward()
        norm = descend(self.adam, self.max_grad_norm)
        follow(self.average, self.actor, self.decay)
        return loss.detach(), norm


class CFPAnalytic(Resumable, UpdateLoop, CoarseToFine):
    """Learns a stage of the coarse-to-fine policy by gradients through the simulation.

    Each update simulates a window of control steps, as short-horizon actor-critic does (SHAC; Xu et al., ICLR 2022). It
    then takes a gradient step of a given size on the actions of the window, and fits the actor to the improved actions
    (PODS; Mora et al., ICML 2021). A critic, which sees the state of the simulation and is needed in training only,
    values the end of the window and learns TD(lambda) targets (SHAC; D.Va, NeurIPS 2025). ``predict`` acts by the actor
    with averaged weights. `cfp.fit` trains all stages, with evaluations and checkpoints.

    Args:
        policy: ``"NetworksPolicy"``.
        env: A `cfp.TorchVecEnv`, in which it is trained. The numbers of robots, particles and substeps are those of the
            environment, the starts and lengths of episodes those of ``config``. Its actions have the size
            ``config.action_size(stage)``.
        config: Options, such as `cfp.preset` returns; None only where stable-baselines3 loads a saved model.
        stage: The stage that it learns, 1 for the coarsest.
        device: Device of the networks, that of the simulation.
        _init_setup_model: Make the networks at once; stable-baselines3 passes False to load a saved model.

    Raises:
        TypeError: ``env`` is not a `cfp.TorchVecEnv`, or ``config`` is None.
    """

    config: AnalyticConfig
    parts = ("regression", "memory", "critic", "collector", "action_step")
    values = ("generator", "empty_windows")
    presets = ("quick",)

    def _setup_model(self) -> None:
        config = self.config
        self.spec = config.actor_spec(self.stage)
        with seeded(config.seed):
            self.actor = build_actor(self.spec).to(self.device)
        self.actor.fix_std()  # its parameters are not the optimiser's
        self.regression = Regression(self.actor, config.learning_rate, config.weight_average, config.max_grad_norm)
        self.features = StateFeatures(displacement=config.displacement)
        with seeded(config.seed):
            critic = mlp(self.features.size(len(config.make_spec().bodies) - 1), 1).to(self.device)
        self.critic = Critic(critic, config)
        networks = {"learned": self.actor, "value": critic, "target": self.critic.target}
        actor = self.trained_actor
        self.policy = NetworksPolicy(self.observation_space, self.action_space, actor=actor, **networks)
        self.generator = torch.Generator(self.device).manual_seed(config.seed)
        if self.env is not None:  # a loaded model can act without one
            self.begin_episodes()

    def begin_episodes(self) -> None:
        """Start new episodes in all elements of the simulation."""
        config = self.config
        self.collector = WindowCollector(self.simulation, lambda: self.features(self.simulation).float(), config)
        self.action_step = ActionStep()
        self.empty_windows = 0
        self._last_obs = self.simulation.observation().cpu().numpy()
        seen = self.observe()[:1]
        with torch.no_grad():
            example = (seen[0], self.actor.outputs(seen, deterministic=True).location[0])
        self.memory = ImageMemory(config.windows_kept * config.window * self.n_envs, example)

    def observe(self) -> Tensor:
        """What the policy sees now, uint8 (B, 3, 64, 64)."""
        return self.spec.filled(self.simulation.observation())

    @staticmethod
    def preset(task: str, name: str) -> AnalyticConfig:
        """Default options for a task, see `cfp.preset`."""
        return analytic_preset(task, name)

    @classmethod
    def create(cls, config: AnalyticConfig, stage: int, folder: Path) -> CFPAnalytic:
        """Networks, memory and environment of a stage."""
        env = make_env(config.for_training(), config.action_size(stage), conditions=config.conditions(stage))
        learner = cls("NetworksPolicy", env, config, stage, choose_device(config.device))
        learner.starts_trained = cls.warm_start(config, stage, folder, learner.actor)
        learner.restart_average()
        return learner

    def restart_average(self) -> None:
        """Let the average of the actor's weights begin with those it has now, with a fixed standard deviation."""
        self.actor.fix_std()
        self.trained_actor.load_state_dict(self.actor.state_dict())

    @classmethod
    def warnings(cls, config: AnalyticConfig, folder: Path, first_stage: int) -> list[str]:
        """Stages that end before their policy learns, and a reward without gradient."""
        lines = [f"{line}; --algo cfp-sac learns from rewards alone" for line in reward_warnings(config)]
        warmup = config.warmup * config.update_every
        for stage in range(first_stage, len(config.ends()) + 1):
            starts_trained = stage > 1 or refines(config, folder, stage)
            if starts_trained and (steps := config.stage_steps(stage)) <= warmup:
                option = f"--warmup {config.warmup}"
                lines.append(f"stage {stage}: only the critic learns in its {steps:,} steps ({option})")
        return lines

    @property
    def steps_without_change(self) -> int:
        """Environment steps of the warm-up, in which only the critic of a trained policy learns."""
        return self.config.warmup * self.config.update_every

    def update(self) -> bool:
        """Simulate one window and learn from it; ``learn`` calls this.

        Returns:
            False if a callback stops the training.

        Raises:
            cfp.NonFiniteError: Actions are not finite, or ten windows in a row had no finite gradient other than 0.
        """
        config, progress = self.config, self.progress
        learning_rate = config.learning_rate * linear_decay(progress)
        step_size = of_stage(config.action_step, self.stage) * linear_decay(progress, config.final_step)
        minibatches = config.minibatches
        if self.starts_trained and self.num_timesteps < self.steps_without_change:
            # steps towards the values of an untrained critic, fitted to a few windows, would spoil the policy
            step_size, minibatches = 0.0, 0
        played = self._improve(step_size)
        if played is None:
            return False
        images, improved, window = played
        self.memory.add(images, improved.flatten(0, 1))
        regression_loss, norms = torch.zeros(()), list[Tensor]()
        for _ in range(minibatches):
            batch = self.memory.sample(config.minibatch_size, self.generator)
            regression_loss, norm = self.regression.update(*batch, learning_rate)
            norms.append(norm)
        check_norms(norms, "actor's regression")
        critic_loss = self.critic.update(window, learning_rate)
        own = {
            "train/critic_loss": critic_loss,
            "train/regression_loss": float(regression_loss),
            "train/action_step": step_size,
            "train/learning_rate": learning_rate,
            "train/limited": float(self.action_step.limited),
        }
        self.record(self.collector.scalars(window) | own)
        return True

    def _improve(self, step_size: float) -> tuple[Tensor, Tensor, Window] | None:
        """Simulate a window and take a gradient step on its actions.

        Args:
            step_size: Root mean square of the step; 0: none, and no gradients are computed.

        Returns:
            Images (T B, 3, 64, 64), improved locations (T, B, C, R, R), and the window before the step; None if a
            callback stops the training.
        """
        images: list[Tensor] = []
        leaves: list[Tensor] = []

        def act(_: Tensor) -> Tensor:
            images.append(self.observe())
            with torch.no_grad():
                outputs = self.actor.outputs(images[-1], generator=self.generator)
                leaves.append(outputs.location.clamp(-BOUND, BOUND))
            return self.actor.act(outputs.at(leaves[-1].requires_grad_()), generator=self.generator).action

        with torch.set_grad_enabled(step_size > 0):
            window = self.collector.collect(act, self.critic, self.after_step)
        self._callback.on_rollout_end()
        if window is None:
            return None
        actions = torch.stack(leaves).detach()
        if not step_size:
            return torch.cat(images), actions, window
        gradients = torch.stack(torch.autograd.grad(short_horizon_loss(window, self.config.gamma), leaves))
        self.simulation.detach()
        self.empty_windows = 0 if gradients.any() else self.empty_windows + 1
        if self.empty_windows >= MOST_EMPTY_WINDOWS:
            raise NonFiniteError(
                f"all gradients of {self.empty_windows} windows in a row are NaN, infinite or 0; a term of the reward "
                f"of {self.config.task} may have no finite derivative, such as the square root at 0"
            )
        improved = self.action_step(actions, gradients, step_size)
        return torch.cat(images), improved, window

    def log_row(self) -> None:
        """Begin the mean return of the next row."""
        self.collector.episodes.recent_returns = []

    def images(self) -> dict[str, np.ndarray]:
        """What the policy does with the observation of the first robot."""
        return policy_pictures(self.trained_actor, self.observe()[:1])

    @property
    def trained_actor(self) -> Actor:
        """The actor with averaged weights."""
        return self.regression.average

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "regression.adam", "critic.adam"], []

    def _excluded_save_params(self) -> list[str]:
        made_again = ["actor", "regression", "features", "critic", "generator", "collector", "action_step", "memory"]
        return [*super()._excluded_save_params(), *made_again, "_callback"]
