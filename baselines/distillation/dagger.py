"""Dataset aggregation (DAgger; Ross et al., AISTATS 2011): the student moves, the teacher says what it should do."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from baselines.common.episodes import Episodes
from baselines.distillation.teachers import Teacher, project
from cfp.envs import disturbances
from dittogym import TorchEnv
from dittogym import core as dynamics
from torchmpm import tree


class Labels(NamedTuple):
    """Some states and what to do there.

    Attributes:
        observations: (n, 3, 64, 64) uint8.
        actions: (n, 2, R, R) on the teacher's grid, or on the student's where that is smaller.
    """

    observations: Tensor
    actions: Tensor


class Dataset:
    """The labels of all rounds; the oldest rounds are dropped when there are too many.

    Args:
        capacity: Labels that are kept at most; an image is 12 KiB, an action 8 R R bytes.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.rounds: list[Labels] = []
        self._packed: list[bytes | None] = []

    def __len__(self) -> int:
        """Number of labels."""
        return sum(len(labels.observations) for labels in self.rounds)

    def add(self, labels: Labels) -> None:
        """Take a round in; the newest is kept whole even if it alone is too large."""
        self.rounds.append(labels)
        self._packed.append(None)
        while len(self.rounds) > 1 and len(self) > self.capacity:
            del self.rounds[0], self._packed[0]

    def sample(self, count: int) -> Labels:
        """Draw labels uniformly, with repetition, from torch's generator."""
        sizes = torch.tensor([len(labels.observations) for labels in self.rounds])
        ends = sizes.cumsum(0)
        picks = torch.randint(int(ends[-1]), (count,))
        places = torch.searchsorted(ends, picks, right=True)
        rows = (picks - (ends - sizes)[places]).tolist()
        chosen = [(self.rounds[place], row) for place, row in zip(places.tolist(), rows, strict=True)]
        return Labels(*(torch.stack([labels[part][row] for labels, row in chosen]) for part in (0, 1)))

    def state_dict(self) -> dict[str, Any]:
        """All labels; images shrink thirtyfold, and each round is packed once."""
        for index, labels in enumerate(self.rounds):
            if self._packed[index] is None:
                self._packed[index] = zlib.compress(labels.observations.numpy().tobytes(), 1)
        packed = [torch.frombuffer(bytearray(images or b""), dtype=torch.uint8) for images in self._packed]
        return {"observations": packed, "actions": [labels.actions for labels in self.rounds]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self._packed = [images.numpy().tobytes() for images in state["observations"]]
        self.rounds = []
        for images, actions in zip(self._packed, state["actions"], strict=True):
            assert images is not None
            pixels = np.frombuffer(bytearray(zlib.decompress(images)), np.uint8)
            self.rounds.append(Labels(torch.from_numpy(pixels.reshape(-1, *TorchEnv.observation_shape)), actions))


def lose(values: Tensor, share: float, grid: int | None = None) -> Tensor:
    """Set a share of the entries to 0 in half of the elements, drawn from torch's generator.

    Args:
        values: (B, ..., A, A).
        share: Of the entries.
        grid: Rows and columns on which they are drawn, see `cfp.envs.disturbances.lose`; A if None.
    """
    if not share:
        return values
    lost = torch.rand(values.shape if grid is None else (*values.shape[:-2], grid, grid)) < share
    lost &= torch.rand(len(values), *[1] * (values.ndim - 1)) < 0.5
    return disturbances.lose(values, lost.to(values.device))


class Collector:
    """Lets a mixture of student and teacher move, and asks the teacher about every state.

    Who moves a robot is drawn anew every ``leg`` steps. A label counts where the teacher looked at that very state, or
    its answer is part of a plan which the robot has followed from its beginning.

    Args:
        env: The simulations, with actions as large as the patch, so that those of any grid can be carried out.
        teacher: Who is asked.
        episodes: Of the simulations.
        leg: Control steps.
        faults: Share of the entries that the student loses, see `lose`, while it looks and moves.
        grid: Rows and columns of the grid on which it decides, where it loses actions; if None, of what it hands over.
    """

    def __init__(
        self,
        env: TorchEnv,
        teacher: Teacher,
        episodes: Episodes,
        leg: int,
        faults: float = 0.0,
        grid: int | None = None,
    ) -> None:
        self.env, self.teacher, self.episodes, self.leg = env, teacher, episodes, leg
        self.faults, self.grid = faults, grid
        self.position = leg
        self.led = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self.lost = self.led.clone()

    @torch.no_grad()
    def collect(self, steps: int, share: float, student: Callable[[Tensor], Tensor]) -> Labels:
        """Move all robots for some control steps.

        Args:
            steps: How many.
            share: Of the legs that the teacher leads; draws come from torch's generator.
            student: From images (B, 3, 64, 64) to actions (B, 2, R, R).
        """
        env, images, actions = self.env, [], []
        self.episodes.recent_returns = []
        seen = dynamics.observe(env.model, env.env_state)
        for _ in range(steps):
            told = self.teacher.act(env, seen)
            if self.teacher.fresh:
                self.lost = torch.zeros_like(self.lost)
                if self.position >= self.leg:
                    self.led, self.position = torch.rand(env.num_envs).to(env.device) < share, 0
            self.position += 1
            follows = self.led & ~self.lost
            counts = ~self.lost if self.teacher.fresh else follows
            images.append(seen[counts].cpu())
            actions.append(told[counts].cpu())
            own = self._enlarged(lose(student(lose(seen, self.faults)), self.faults, self.grid))
            seen = self._step(tree.where(follows, self._enlarged(told), own))
        return Labels(torch.cat(images), torch.cat(actions))

    def _enlarged(self, action: Tensor) -> Tensor:
        return project(action, self.env.action_resolution, self.env.spec.patch)

    def _step(self, action: Tensor) -> Tensor:
        """Carry out an action, begin new episodes where they are over, return the images."""
        seen, reward, terminated, _, info = self.env.step(action)
        out = self.episodes.record(reward, terminated | ~info["finite"])
        if bool(out.any()):
            self.episodes.restart(out, terminated, info["finite"])
            self.lost = self.lost | out
            seen = dynamics.observe(self.env.model, self.env.env_state)
        return seen

    def state_dict(self) -> dict[str, Any]:
        """What the next round depends on beside the student."""
        own = {"position": self.position, "led": self.led.cpu(), "lost": self.lost.cpu()}
        return {"episodes": self.episodes.state_dict(), "teacher": self.teacher.state_dict(), **own}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self.episodes.load_state_dict(state["episodes"])
        self.teacher.load_state_dict(state["teacher"])
        self.position = state["position"]
        self.led, self.lost = state["led"].to(self.led), state["lost"].to(self.lost)
