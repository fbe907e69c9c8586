"""The Gymnasium ids ``dittogym/{task}-{coarse|fine}-v0``."""

from __future__ import annotations

import gymnasium

from dittogym.tasks import TASKS, make_spec


def register() -> None:
    """Register every task in both resolutions; done on ``import dittogym``."""
    for task in TASKS:
        for resolution in ("coarse", "fine"):
            gymnasium.register(
                id=f"dittogym/{task}-{resolution}-v0",
                entry_point="dittogym.env:Env",
                vector_entry_point="dittogym.vector:BatchEnv",
                max_episode_steps=make_spec(task).horizon,
                kwargs={"task": task, "resolution": resolution},
            )
