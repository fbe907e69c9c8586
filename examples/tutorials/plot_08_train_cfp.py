r"""
Train the coarse-to-fine policy
===============================

This tutorial trains a policy with the command line. It uses few robots, particles and steps, so that it takes half a
minute. For a useful policy leave these options out, as ``make demo`` does; training then takes a few minutes.
"""

# %%
# ``--dry-run`` prints the options that result from the preset and the command line; here are the last ones.

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import cfp
import dittogym

folder = tempfile.TemporaryDirectory()
out = Path(folder.name) / "run"
small = "--learner sac --num-envs 8 --particles 1000 --batch-size 64 --update-start 64 --random-steps 120 40"
budget = "--gradient-steps 1 --steps 1440 --handover 960 --eval-every 480 --eval-episodes 2 --no-video"
command = [sys.executable, "-m", "cfp.train", "--task", "shapematch", "--seed", "0", "--out", str(out)]
command += [*small.split(), *budget.split()]


def run(*more: str) -> str:
    """Run the command and return its output."""
    return subprocess.run([*command, *more], check=True, capture_output=True, text=True).stdout


print("\n".join(run("--dry-run").splitlines()[-8:]))

# %%
# Train the policy. The first stage learns actions of 32 x 32 cells. The second stage freezes the first one and learns
# corrections of 64 x 64 cells.

print(run())

# %%
# A run is a folder. If it is interrupted, the same command with ``--resume`` continues it, and the result is the same
# bit for bit.

for path in sorted(out.iterdir()):
    print(path.name)
figure, axis = plt.subplots(figsize=(8, 4))
axis.imshow(plt.imread(out / "curve.png"))
axis.axis("off")

# %%
# The policy has the ``predict`` method of stable-baselines3. Loading it never runs code from the file.

policy = cfp.load(out)
env = dittogym.TorchEnv("shapematch", num_envs=2, resolution=policy.resolution, particles=1000)
observation, _ = env.reset(seed=7)
action, _ = policy.predict(observation.numpy())
print(action.shape, policy.description["task"])

assert action.shape == (2, 2, 64, 64)
assert (out / "stage1.safetensors").exists() and (out / "results.json").exists()
folder.cleanup()
