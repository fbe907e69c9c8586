"""Dataset aggregation (DAgger; Ross et al., AISTATS 2011): the student acts, the teacher labels the visited states."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from baselines.distillation.teachers import Teacher, project
from cfp.analytic.window import Episodes
from cfp.envs import disturbances
from cfp.learner import Resumable, compress, decompress
from dittogym import TorchEnv
from torchmpm import tree


class Labels(NamedTuple):
    """Observations and the teacher's actions."""

    observations: Tensor  # (n, 3, 64, 64) uint8
    actions: Tensor  # (n, 2, R, R) on the teacher's grid, or on the student's where that is smaller


class Dataset:
    """The labels of all rounds; the oldest rounds are dropped when there are too many."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.rounds: list[Labels] = []
        self._compressed: list[Tensor | None] = []

    def __len__(self) -> int:
        """Number of labels."""
        return sum(len(labels.observations) for labels in self.rounds)

    def add(self, labels: Labels) -> None:
        """Add a round, if it has labels; the newest is kept whole even if it alone exceeds the capacity."""
        if not len(labels.observations):
            return
        self.rounds.append(labels)
        self._compressed.append(None)
        while len(self.rounds) > 1 and len(self) > self.capacity:
            del self.rounds[0], self._compressed[0]

    def sample(self, count: int) -> Labels:
        """Draw labels uniformly with replacement, from torch's generator."""
        sizes = torch.tensor([len(labels.observations) for labels in self.rounds])
        ends = sizes.cumsum(0)
        picks = torch.randint(int(ends[-1]), (count,))
        rounds = torch.searchsorted(ends, picks, right=True)
        rows = (picks - (ends - sizes)[rounds]).tolist()
        chosen = [(self.rounds[index], row) for index, row in zip(rounds.tolist(), rows, strict=True)]
        return Labels(*(torch.stack([labels[part][row] for labels, row in chosen]) for part in (0, 1)))

    def state_dict(self) -> dict[str, Any]:
        """All labels; the images of each round are compressed once."""
        for index, labels in enumerate(self.rounds):
            if self._compressed[index] is None:
                self._compressed[index] = compress(labels.observations)
        return {"observations": list(self._compressed), "actions": [labels.actions for labels in self.rounds]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self._compressed = list(state["observations"])
        images = [decompress(content, TorchEnv.observation_shape) for content in state["observations"]]
        self.rounds = [Labels(*pair) for pair in zip(images, state["actions"], strict=True)]


def drop_entries(values: Tensor, probability: float, grid: int | None = None) -> Tensor:
    """Set random entries of values (B, ..., A, A) to 0 in half of the elements, drawn on a coarser ``grid`` if any."""
    if not probability:
        return values
    mask = torch.rand(values.shape if grid is None else (*values.shape[:-2], grid, grid)) < probability
    mask &= torch.rand(len(values), *[1] * (values.ndim - 1)) < 0.5
    return disturbances.drop(values, mask.to(values.device))


class Collector(Resumable):
    """Lets a mixture of student and teacher act, and labels the states by the teacher.

    Who controls a robot is drawn anew every ``switch_every`` steps. A label is kept where the teacher's action was
    computed from that very state, or is part of a plan which the robot has followed from its beginning.
    """

    parts = ("episodes", "teacher")
    values = ("steps_since_switch", "teacher_acts", "restarted")

    def __init__(
        self, teacher: Teacher, episodes: Episodes, switch_every: int, dropout: float = 0.0, grid: int | None = None
    ) -> None:
        self.env, self.teacher, self.episodes, self.switch_every = episodes.env, teacher, episodes, switch_every
        self.dropout, self.grid = dropout, grid
        self.steps_since_switch = switch_every
        self.teacher_acts = torch.zeros(self.env.num_envs, dtype=torch.bool, device=self.env.device)
        self.restarted = self.teacher_acts.clone()  # a new episode began since the teacher's plan was made

    @torch.no_grad()
    def collect(
        self,
        steps: int,
        beta: float,
        student: Callable[[Tensor], Tensor],
        after_step: Callable[[Tensor, list[dict[str, Any]]], bool],
    ) -> Labels | None:
        """Act for some control steps and return the labels; None if ``after_step`` returns False.

        The teacher controls a robot with probability ``beta``, drawn from torch's generator; the student maps images
        (B, 3, 64, 64) to actions (B, 2, R, R), and loses entries of both with probability ``dropout``.
        """
        env, images, actions = self.env, [], []
        self.episodes.recent_returns = []
        observation = env.observation()
        for _ in range(steps):
            teacher_action = self.teacher.act(env, observation)
            if self.teacher.fresh:
                self.restarted = torch.zeros_like(self.restarted)
                if self.steps_since_switch >= self.switch_every:
                    draws = torch.rand(env.num_envs).to(env.device)
                    self.teacher_acts, self.steps_since_switch = draws < beta, 0
            self.steps_since_switch += 1
            follows = self.teacher_acts & ~self.restarted
            valid = ~self.restarted if self.teacher.fresh else follows
            images.append(observation[valid].cpu())
            actions.append(teacher_action[valid].cpu())
            student_action = student(drop_entries(observation, self.dropout))
            student_action = self._enlarge(drop_entries(student_action, self.dropout, self.grid))
            observation, done, infos = self._step(tree.where(follows, self._enlarge(teacher_action), student_action))
            if not after_step(done, infos):
                return None
        return Labels(torch.cat(images), torch.cat(actions))

    def _enlarge(self, action: Tensor) -> Tensor:
        return project(action, self.env.action_resolution, self.env.spec.patch)

    def _step(self, action: Tensor) -> tuple[Tensor, Tensor, list[dict[str, Any]]]:
        """Carry out an action, start new episodes where they are over; the next observation, which, and their infos."""
        observation, reward, terminated, _, info = self.env.step(action)
        done = self.episodes.record(reward, terminated)
        infos = self.episodes.infos(done)
        if bool(done.any()):
            self.episodes.restart(done, terminated, info["finite"])
            self.restarted = self.restarted | done
            observation = self.env.observation()
        return observation, done, infos
