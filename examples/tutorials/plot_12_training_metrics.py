r"""
Reading the training metrics
============================

A run writes its metrics to ``progress.csv`` and TensorBoard. This tutorial trains a small policy and explains the
most important ones. :doc:`/reference/logs` lists all of them.
"""

# %%
# Few particles and few steps are enough to see the shape of the curves.

import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

folder = tempfile.TemporaryDirectory()
out = Path(folder.name) / "run"
options = """
    --task shapematch --learner sac --seed 0 --particles 500 --num-envs 8 --steps 1200 --handover 0.667
    --batch-size 64 --gradient-steps 1 --update-start 64 --random-steps 120 40
    --log-every 40 --eval-every 400 --eval-episodes 2 --no-video
"""
command = [sys.executable, "-m", "cfp.train", "--out", str(out), *options.split()]
subprocess.run(command, check=True, capture_output=True)
with (out / "progress.csv").open() as file:
    rows = list(csv.DictReader(file))
print(f"{len(rows)} rows, columns: {', '.join(rows[0])}")


def series(name: str) -> tuple[list[int], list[float]]:
    """Steps and values of a column, without empty cells."""
    points = [(int(row["step"]), float(row[name])) for row in rows if row[name]]
    return [step for step, _ in points], [value for _, value in points]


# %%
# The main metrics
# ----------------
#
# - ``rollout/return`` is the return of training episodes, with exploration. ``evaluations.csv`` contains the returns of
#   the policy in separate evaluation episodes.
# - ``train/critic_loss`` should decrease after its first peak and then stay constant. If it keeps growing, the values
#   diverge.
# - ``train/q`` and the reward statistics show the scale of the values. Rewards are normalised, so 0 is an average
#   reward.
# - ``train/entropy`` decreases as the policy becomes more certain. If it is minimal from the start, the policy does not
#   explore; if it never decreases, the critics do not distinguish actions.
# - ``train/gate`` exists from the second stage on: 0 keeps the coarse action, and 1 replaces it.

shown = ("rollout/return", "train/critic_loss", "train/q", "train/entropy", "train/reward_std", "train/gate")
figure, axes = plt.subplots(2, 3, figsize=(11, 5.4))
for axis, name in zip(axes.flat, shown, strict=True):
    axis.plot(*series(name))
    axis.axvline(800, color="0.7", linestyle="--")
    axis.set(title=name, xlabel="environment steps")
figure.suptitle("dashed line: start of the second stage")
figure.tight_layout()

# %%
# Signs of trouble
# ----------------
#
# - A loss that is not finite stops the run with an error that names it. The last checkpoint remains valid.
# - ``rollout/length`` decreases when episodes end early, for example because robots tear.
# - If ``time/steps_per_second`` (TensorBoard only) decreases over hours, other programs use the machine.
#
# ``tensorboard --logdir runs`` shows all metrics live, with images of action and gate at every evaluation.

gate_steps, gates = series("train/gate")
losses = series("train/critic_loss")[1]
folder.cleanup()

assert min(gate_steps) > 800, "the first stage has no gate"
assert all(0 < gate < 1 for gate in gates)
assert all(loss > 0 for loss in losses)
