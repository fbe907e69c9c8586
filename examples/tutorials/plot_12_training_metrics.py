r"""
Reading the training metrics
============================

A run writes what it measures into ``progress.csv`` and TensorBoard. This page trains a tiny one and says what to look
at. Every column is explained on the page of scalars.
"""

# %%
# One level, few particles, few steps: just enough for curves to have a shape.

import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

folder = tempfile.TemporaryDirectory()
out = Path(folder.name) / "run"
options = "--task shapematch --seed 0 --num-envs 8 --particles 500 --batch-size 64 --update-start 64 --no-video"
budget = "--random-steps 120 40 --steps 1200 --handover 800 --gradient-steps 1 --log-every 40 --eval-every 400"
command = [
    sys.executable,
    "-m",
    "cfp.train",
    "--out",
    str(out),
    "--eval-episodes",
    "2",
    *options.split(),
    *budget.split(),
]
subprocess.run(command, check=True, capture_output=True)
with (out / "progress.csv").open() as file:
    rows = list(csv.DictReader(file))
print(f"{len(rows)} rows, columns: {', '.join(rows[0])}")


def series(name: str) -> tuple[list[int], list[float]]:
    """Steps and values of a column, where it has one."""
    points = [(int(row["step"]), float(row[name])) for row in rows if row[name]]
    return [step for step, _ in points], [value for _, value in points]


# %%
# What to look at first
# ---------------------
#
# - ``rollout/return`` is what exploring robots earn; ``evaluations.csv`` holds what the policy earns on other layouts.
# - ``train/critic_loss`` should fall from its first peak and stay flat. If it grows without end, values run away.
# - ``train/q`` and the reward statistics tell the scale. Rewards are centred: values near zero mean "as usual".
# - ``train/entropy`` falls as the policy becomes sure. At its least value at once, the policy has stopped exploring;
#   if it never falls, the critic cannot tell actions apart.
# - ``train/gate`` exists from the second level on: 0 keeps the coarse action, 1 replaces it.

shown = ("rollout/return", "train/critic_loss", "train/q", "train/entropy", "train/reward_std", "train/gate")
figure, axes = plt.subplots(2, 3, figsize=(11, 5.4))
for axis, name in zip(axes.flat, shown, strict=True):
    axis.plot(*series(name))
    axis.axvline(800, color="0.7", linestyle="--")
    axis.set(title=name, xlabel="environment steps")
figure.suptitle("the dashed line is the handover from the coarse level to the fine one")
figure.tight_layout()

# %%
# Signs of trouble
# ----------------
#
# - A non-finite loss stops the run with an error that names it; nothing is hidden, and the last checkpoint is good.
# - Episodes that end early show in ``rollout/length``. In tasks that can tear a robot it is the first thing to fall.
# - ``time/steps_per_second`` (TensorBoard only) falling over hours means that something else wants the machine.
#
# ``tensorboard --logdir runs`` shows all of it live, with pictures of action and gate at every evaluation.

gate_steps, gates = series("train/gate")
losses = series("train/critic_loss")[1]
folder.cleanup()

assert min(gate_steps) > 800, "the coarse level has no gate"
assert all(0 < gate < 1 for gate in gates)
assert all(loss > 0 for loss in losses)
