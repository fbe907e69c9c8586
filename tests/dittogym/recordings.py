"""Replays recorded episodes of the reference implementation and lists how far ours is from them.

``reference.npz`` beside this file holds an extract of the recordings, so that every clone can compare with them.
``PYTHONPATH=.:tests python tests/dittogym/recordings.py`` writes it from the complete recordings.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import reference
import torch

import dittogym
from dittogym import core, make_spec
from dittogym.action import patch_field, place
from dittogym.geometry import centre_in_window
from torchmpm.boundary import constrain
from torchmpm.grid import PAD
from torchmpm.substep import grid_velocity, particles_to_grid
from torchmpm.transfer import interpolate

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "reference"
EXTRACT = Path(__file__).with_name("reference.npz")

#: Bounds by quantity of the float64 files. The physics starts from the recorded actuation field, because the reference
#: computes that field in float32: `grid_actuation`, its distance from ours, is one unit in the last place of float32 at
#: 82 Pa. Where matter yields, the reference's SVD drops off-diagonal stretches under 1e-5, which moves its own F by up
#: to 1e-5 and all that follows from it.
SMALL = {
    "sub1_x": 1e-12,
    "sub1_v": 1e-12,
    "sub1_C": 1e-9,
    "sub1_F": 1e-12,
    "sub1_grid_actuation": 2e-5,
    "sub1_particle_actuation": 1e-12,
    "sub1_grid_v": 1e-12,
    "sub1_grid_m": 1e-9,
    "sub10_x": 1e-7,
    "sub10_F": 1e-4,
    "sub100_x": 1e-7,
    "sub100_v": 1e-4,
    "sub100_C": 1e-2,
    "sub100_F": 1e-4,
    "sub100_Jp": 1e-12,
}
#: Tasks whose rewards look at a selection of particles: a fixed number of them in the reference, a share in ours, so
#: that rewards agree at full size only.
SHARES = ("grow", "catch", "slot")
EPISODE = {
    "com": 1e-4,
    "com_object": 1e-4,
    "anchor": 1e-4,
    "x_std": 1e-4,
    "v_mean": 1e-2,
    "reward": 0.01,  # of its range
    "terminated": 0.0,
    "action_norm": 1e-5,  # relative
    "kinetic": 0.01,  # of its largest value
    "det_F_mean": 1e-3,
    "rest": 1.0,  # of the bounds below
    "obs": 0.005,  # share of entries that differ by more than 8
}
#: Bounds at rest by task, of rewards in the first ten steps and of the centre after them. Rewards differ by the order
#: of summation alone; in GROW also by which of equally high particles belong to the tip.
REST_REWARD, REST_CENTRE = {"slot": 1e-2, "dig": 5e-3, "grow": 2e-3}, {"obstacle": 1e-4}


def load(name: str) -> dict[str, np.ndarray]:
    """One recording: complete where the folder is there, otherwise the extract."""
    if FOLDER.is_dir():
        with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as data:
            return dict(data)
    return load_extract(name)


def load_extract(name: str) -> dict[str, np.ndarray]:
    with np.load(EXTRACT, allow_pickle=False) as data:
        return {key.removeprefix(f"{name}/"): data[key] for key in data if key.startswith(f"{name}/")}


def extract(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What is kept of a recording: every ``particle_stride``-th particle and every ``image_stride``-th image.

    Initial positions are left out where seed 0 draws the same ones.
    """
    particle_stride, image_stride = len(data["x0"]) // 50, max(len(data["actions"]) // 3, 1)
    kept = {"particle_stride": np.array(particle_stride), "image_stride": np.array(image_stride)}
    for key in ("config", "actions", "mass", *EPISODE, *SMALL):
        if key not in data:
            continue
        value = data[key]
        if key == "obs":
            value = value[::image_stride]
        elif key == "sub1_grid_actuation":
            value = value.astype(np.float32)  # the reference computes it in this precision
        elif key.startswith("sub") and "grid" not in key:
            value = value[::particle_stride]
        kept[key] = value
    env = make(kept)
    if env.state.x[0].shape != data["x0"].shape or worst(env.state.x[0], data["x0"]) > 1e-15:
        kept["x0"] = data["x0"]
    return kept


def make(data: dict[str, np.ndarray]) -> dittogym.Env:
    """The environment that a file was recorded with, after a reset."""
    config = json.loads(str(data["config"]))
    task, resolution = config["task"].split("-")
    dtype = "float64" if config["f64"] else "float32"
    env = reference.make(task, resolution, particles=tuple(config["particle_num_list"]), dtype=dtype)
    env.reset(seed=0)
    if "x0" in data:  # one recording parks particles that it does not need outside the window
        inner = env.torch_env
        inner.env_state, _ = core.reset(inner.model, torch.as_tensor(data["x0"])[None].to(inner.state.x))
    return env


def action(data: dict[str, np.ndarray], env: dittogym.Env, step: int) -> np.ndarray:
    return data["actions"][step].reshape(env.action_space.shape)


def worst(ours: torch.Tensor | np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(np.asarray(ours, dtype=np.float64) - theirs.astype(np.float64)).max())


def substep_errors(data: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest difference of every recorded quantity after 1, 10 and 100 substeps of the first action."""
    env = make(data)
    start, solver = env.torch_env.env_state, env.torch_env.model.solver
    recorded = torch.as_tensor(data["sub1_grid_actuation"]).permute(2, 0, 1)[None].to(env.state.x)
    errors, state, done = _first_grid(data, env, recorded), start.particles, 0
    for count in (1, 10, 100):
        state = solver.step(state, recorded, substeps=count - done, origin=start.origin)
        done = count
        for field in ("x", "v", "C", "F", "Jp"):
            key = f"sub{count}_{field}"
            if key in SMALL:
                errors[key] = worst(getattr(state, field)[0, :: data.get("particle_stride", 1)], data[key])
    return errors


def _first_grid(data: dict[str, np.ndarray], env: dittogym.Env, recorded: torch.Tensor) -> dict[str, float]:
    """Actuation, mass and velocity on the nodes in the first substep."""
    spec, solver, start = env.torch_env.spec, env.torch_env.model.solver, env.torch_env.env_state
    first = torch.as_tensor(action(data, env, 0))[None].to(env.state.x)
    patch = patch_field(first, spec.patch, spec.max_actuation)
    ours = place(patch, centre_in_window(spec.patch_centre, start.centre, start.origin), solver.grid.resolution)
    scene = solver.scene(start.particles, recorded, start.origin)
    grid = particles_to_grid(scene, start.particles.components())
    along = torch.stack(interpolate(grid.stencil, scene.actuation), -1)[0]

    def on_nodes(values: torch.Tensor) -> torch.Tensor:
        return values.view(solver.grid.width, solver.grid.width)[PAD:-PAD, PAD:-PAD]

    velocity = constrain(scene.faces, grid_velocity(scene, grid.momentum))
    velocity = torch.stack([on_nodes(v[0]) for v in velocity], -1)
    heavy = data["sub1_grid_m"][..., None] > 1e-9
    return {
        "sub1_grid_actuation": worst(ours, recorded.numpy()),
        "sub1_particle_actuation": worst(along[:: data.get("particle_stride", 1)], data["sub1_particle_actuation"]),
        # On nodes with next to no mass, velocity is a quotient of two rounding errors.
        "sub1_grid_v": worst(velocity.numpy() * heavy, data["sub1_grid_v"] * heavy),
        "sub1_grid_m": worst(on_nodes(grid.momentum[0, 0]), data["sub1_grid_m"]),
    }


def episode_errors(data: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest difference over the recorded episode, in the measure that :data:`EPISODE` names."""
    env = make(data)
    inner = env.torch_env
    robot = inner.model.num_robot_particles
    rows: dict[str, list[Any]] = {name: [] for name in EPISODE}
    for t in range(len(data["actions"])):
        observation, reward, terminated, _, info = env.step(action(data, env, t))
        x, v, F = env.state.x[0, :robot], env.state.v[0], env.state.F[0, :robot]
        rows["com"].append(info["com"])
        if "object_com" in info:
            rows["com_object"].append(info["object_com"])
        rows["anchor"].append(inner.env_state.origin[0])
        rows["x_std"].append(x.std(0, correction=0))
        rows["v_mean"].append(v[:robot].mean(0))
        rows["reward"].append(reward)
        rows["terminated"].append(terminated)
        rows["action_norm"].append(inner._actuation.flatten(2).norm(dim=2).sum())
        rows["kinetic"].append(0.5 * (torch.as_tensor(data["mass"]) * v.square().sum(-1)).sum())
        rows["det_F_mean"].append((F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]).mean())
        rows["obs"].append(observation)
    ours = {name: np.stack(values) for name, values in rows.items() if values}
    ours["obs"] = ours["obs"][:: data.get("image_stride", 1)]
    errors = {name: worst(values, data[name]) for name, values in ours.items()}
    if inner.spec.name in SHARES and robot != make_spec(inner.spec.name).robot.count:
        del errors["reward"]
    else:
        errors["reward"] /= max(float(np.ptp(data["reward"])), 10.0)
    errors["kinetic"] /= float(data["kinetic"].max()) or 1.0
    errors["action_norm"] /= float(data["action_norm"].max()) or 1.0
    if not data["actions"].any():
        early = worst(ours["reward"][:10], data["reward"][:10]), worst(ours["com"][9], data["com"][9])
        task = inner.spec.name
        errors["rest"] = max(early[0] / REST_REWARD.get(task, 1e-3), early[1] / REST_CENTRE.get(task, 2e-5))
    errors["obs"] = float((np.abs(ours["obs"].astype(int) - data["obs"].astype(int)) > 8).mean())
    return errors


if __name__ == "__main__":
    names = sorted(path.stem for path in FOLDER.glob("*.npz"))
    found = {f"{name}/{key}": value for name in names for key, value in extract(load(name)).items()}
    np.savez_compressed(EXTRACT, **found)
