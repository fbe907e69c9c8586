"""The interface of trained policies, whatever trained them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor


class Policy(PolicyPredictor, Protocol):
    """A trained policy of any kind, as it comes from its file."""

    @property
    def uses_image(self) -> bool:
        """Whether it uses the pixels of the observation."""

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions."""

    @property
    def deterministic_by_default(self) -> bool:
        """Whether the run that trained it evaluates it without noise."""

    @property
    def description(self) -> dict[str, Any]:
        """What it is and comes from; ``layout`` is the seed of the one particle layout it was made for, if any."""


@runtime_checkable
class SeesState(Protocol):
    """A policy that looks at the state of the simulation beside or instead of the image."""

    def attached(self, env: Any) -> PolicyPredictor:
        """The same policy, looking at a `dittogym.TorchEnv`."""


@runtime_checkable
class DisturbablePolicy(Protocol):
    """A policy whose decisions are not on an action grid, from which its actions are computed."""

    def through(self, change: Callable[[np.ndarray], np.ndarray]) -> Policy:
        """The same policy, with ``change`` applied to its decisions (B, ...) before they become actions."""
