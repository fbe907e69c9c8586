"""System identification: which matter is this robot made of, judging by its silhouettes alone?

A robot of unknown stiffness (second Lame parameter mu) and yield stress is driven by known muscles and filmed. Gradient
descent through the simulation finds the constants with which a simulated robot, filled with other particles, makes the
same film. Run `python examples/identify_material.py`.
"""

import argparse
import math

import torch
from torch import Tensor

import dittogym
from dittogym.soft import soft_silhouette

STEPS, RESOLUTION = 10, 4
TRUTH = {"mu": 700.0, "yield_stress": 45.0}
GUESS = {"mu": 500.0, "yield_stress": 62.0}
TOLERANCE = 0.05


def muscles() -> Tensor:
    """Actions (T, 1, 2, R, R): a wave that stretches and shears, slack in the last third to see what springs back."""
    row, column = torch.meshgrid(*[torch.arange(RESOLUTION) / RESOLUTION] * 2, indexing="ij")
    actions = torch.zeros(STEPS, 1, 2, RESOLUTION, RESOLUTION)
    for step in range(2 * STEPS // 3):
        actions[step, 0, 0] = torch.sin(2 * math.pi * (column + 0.1 * step))
        actions[step, 0, 1] = -torch.cos(2 * math.pi * (row - 0.1 * step))
    return 0.8 * actions


def film(env: dittogym.TorchEnv, seed: int, physics: dict[str, Tensor]) -> Tensor:
    """Soft silhouettes (T, 64, 64) of a robot of the given matter; the graph reaches back to its constants."""
    env.reset(seed=seed, options={"physics": physics})
    pictures = []
    for action in muscles():
        env.step(action)
        pictures.append(soft_silhouette(env.soft_observation())[0])
    return torch.stack(pictures)


def identify(env: dittogym.TorchEnv, recording: Tensor, iterations: int) -> dict[str, float]:
    """Constants whose film is nearest to the recording, by Adam on their logarithms."""
    logarithm = torch.tensor([math.log(value) for value in GUESS.values()], requires_grad=True)
    adam = torch.optim.Adam([logarithm], lr=0.06, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, iterations, 0.003)
    for iteration in range(iterations):
        physics = dict(zip(GUESS, logarithm.exp(), strict=True))
        loss = (film(env, 0, physics) - recording).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        schedule.step()
        if iteration % 5 == 0:
            values = ", ".join(f"{name} {value.item():.1f}" for name, value in physics.items())
            print(f"{iteration:3d}  loss {loss.item():.6f}  {values}")
    return dict(zip(GUESS, logarithm.detach().exp().tolist(), strict=True))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=40)
    arguments = parser.parse_args()
    env = dittogym.TorchEnv("shapematch", resolution=RESOLUTION, particles="lite")
    with torch.no_grad():
        recording = film(env, 1, {name: torch.tensor(value) for name, value in TRUTH.items()})
    found = identify(env, recording, arguments.iterations)
    errors = {name: found[name] / TRUTH[name] - 1 for name in TRUTH}
    for name, true in TRUTH.items():
        print(f"{name}: true {true:.1f} Pa, guess {GUESS[name]:.1f}, found {found[name]:.1f} ({errors[name]:+.1%})")
    assert all(abs(error) < TOLERANCE for error in errors.values()), errors
