"""Short rollouts of all tasks against numbers kept beside this file: the dynamics do not change unnoticed.

The ids end in a version, and published figures rest on what happens under it. A change of the dynamics, the rewards or
the observations that moves these numbers therefore means a new version id (``-v1``), not only a new file. After a
change that is meant to be seen here, such as a new task, write its rollout anew with
``python tests/dittogym/test_golden.py TASK`` and look at the difference.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny import TASKS, begun

import dittogym

FILE = Path(__file__).with_name("golden.json")
#: Everything that is fixed but the task; enough substeps for robots that are thrown to flow and to hit something.
OPTIONS = {"particles": 400, "substeps": 50, "dtype": "float64", "backend": "eager", "action_layout": "grid"}
STEPS = 5
#: Initial velocity of all particles of the robot, m/s.
THROW = (1.0, -2.0)


@torch.no_grad()
def rollout(task: str) -> list[dict[str, Any]]:
    """Centres, spread, reward terms and channel sums of the observation after each step under a moving wave."""
    env = begun(dittogym.TorchEnv(task, 1, **OPTIONS))
    env.state.v[:, : env.model.num_robot_particles] = torch.tensor(THROW, dtype=env.dtype)
    c, r, s = np.indices(env.action_shape)
    rows = []
    for t in range(1, STEPS + 1):
        action = torch.as_tensor(np.sin(0.3 * t + 0.7 * r + 1.1 * s + 2 * c))[None]
        observation, _, terminated, _, info = env.step(action)
        rows.append(
            {
                "com": info["com"][0].tolist(),
                "split": float(info["split"]),
                "terms": {name: float(term) for name, term in info["reward_terms"].items()},
                "object_com": info["object_com"][0].tolist() if "object_com" in info else [],
                "observation": observation[0].flatten(1).sum(1).tolist(),
                "terminated": bool(terminated),
            }
        )
    return rows


@pytest.mark.parametrize("task", TASKS)
def test_the_dynamics_are_those_of_this_version(task: str) -> None:
    kept = json.loads(FILE.read_text())["rollouts"][task]
    for step, (ours, golden) in enumerate(zip(rollout(task), kept, strict=True), start=1):
        assert ours.keys() == golden.keys() and ours["terms"].keys() == golden["terms"].keys()
        for name in ("com", "split", "terms", "object_com"):
            assert ours[name] == pytest.approx(golden[name], rel=1e-9, abs=1e-9), f"{name} after step {step}"
        # A mean on the edge between two codes may fall to either side.
        assert ours["observation"] == pytest.approx(golden["observation"], abs=2), f"observation after step {step}"
        assert ours["terminated"] == golden["terminated"]


def test_the_file_is_of_these_settings_and_tasks() -> None:
    kept = json.loads(FILE.read_text())
    assert kept["settings"] == settings() and kept["rollouts"].keys() == set(TASKS)


def settings() -> dict[str, Any]:
    """What the file was written with."""
    return {"options": OPTIONS, "steps": STEPS, "throw": list(THROW), "seed": 0}


def main() -> None:
    """Write the rollouts of the tasks that are given, or of all, anew, a line for each step."""
    kept, blocks = json.loads(FILE.read_text())["rollouts"], []
    for task in TASKS:
        rows = rollout(task) if task in (sys.argv[1:] or TASKS) else kept[task]
        lines = ",\n    ".join(map(json.dumps, rows))
        blocks.append(f'  "{task}": [\n    {lines}\n  ]')
    body = ",\n".join(blocks)
    FILE.write_text(f'{{"settings": {json.dumps(settings())},\n "rollouts": {{\n{body}\n}}}}\n')
    print(f"wrote {FILE}")


if __name__ == "__main__":
    main()
