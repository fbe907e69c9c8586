"""Error of the soft observation and the soft rewards, the figures of docs/concepts/gradients.md.

Run `python benchmarks/soft.py`; `--tasks run kick` for some tasks only.
"""

import argparse

import torch
from fidelity import wave, zeros

import dittogym
from dittogym.observation import silhouette, soft_silhouette

STEPS = 30


@torch.no_grad()
def gaps(task: str, particles: str, policy) -> list[float]:
    """Mean differences over 30 steps (or until the episode ends) from seed 0, and those to another layout."""
    env, other = (dittogym.TorchEnv(task, particles=p, action_layout="grid") for p in (particles, "full"))
    env.reset(seed=0)
    other.reset(seed=1)
    rows = []
    for t in range(STEPS):
        soft, reward, terminated, _, info = env.step(policy(env, t), soft=True)
        image = env.save().observation
        on, other_on = silhouette(image), silhouette(other.step(policy(other, t))[0])
        difference = (soft - image.to(soft)).abs()
        rows.append(
            (
                (on ^ (soft_silhouette(soft) > 0.5)).sum().item(),
                (on ^ other_on).sum().item(),
                difference[:, 0].mean().item(),
                difference[:, 1:].mean().item(),
                (reward - info["true_reward"]).item(),
            )
        )
        if terminated:
            break
    means = torch.tensor(rows).mean(0).tolist()
    return [*means, max(abs(row[-1]) for row in rows)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(dittogym.TASKS), choices=dittogym.TASKS)
    tasks = parser.parse_args().tasks
    print("| task | particles | actions | pixels wrong | (other) | occupancy | velocity | reward, mean | at most |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for task in tasks:
        for particles in ("full", "lite"):
            for policy in (zeros, wave):
                wrong, layout, occupancy, velocity, mean, most = gaps(task, particles, policy)
                pixels = f"{wrong:.0f} | {layout:.0f} | {occupancy:.2f} | {velocity:.2f}"
                print(f"| {task} | {particles} | {policy.__name__} | {pixels} | {mean:+.3f} | {most:.3f} |", flush=True)


if __name__ == "__main__":
    main()
