r"""
Train the coarse-to-fine policy
===============================

One command trains; this page gives it few robots, few particles and few steps, so that it ends in half a minute. For
a policy that is worth something leave these options out and wait some minutes: ``make demo`` does.
"""

# %%
# ``--dry-run`` first: it prints every option as it comes out of the preset and the command line, and what the run
# will cost.

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import cfp
import dittogym

folder = tempfile.TemporaryDirectory()
out = Path(folder.name) / "run"
small = (
    "--num-envs 8 --particles 1000 --batch-size 64 --update-start 64 --random-steps 120 40 --gradient-steps 1".split()
)
budget = "--steps 1440 --handover 960 --eval-every 480 --eval-episodes 2 --no-video".split()
command = [sys.executable, "-m", "cfp.train", "--task", "shapematch", "--seed", "0", "--out", str(out), *small, *budget]


def run(*more: str) -> str:
    """What the command prints."""
    return subprocess.run([*command, *more], check=True, capture_output=True, text=True).stdout


print("\n".join(run("--dry-run").splitlines()[-8:]))

# %%
# Now for real. The first stage learns on a 32 x 32 grid; the second freezes it and learns, on 64 x 64, where to be
# finer.

print(run())

# %%
# A run is a folder. If it is interrupted, the same command with ``--resume`` goes on where it stopped, to the last
# bit.

for path in sorted(out.iterdir()):
    print(path.name)
figure, axis = plt.subplots(figsize=(8, 4))
axis.imshow(plt.imread(out / "curve.png"))
axis.axis("off")

# %%
# The policy has the interface of stable-baselines3, and loading it never runs code from the file.

policy = cfp.load(out)
env = dittogym.TorchEnv("shapematch", num_envs=2, resolution=policy.resolution, particles=1000)
observation, _ = env.reset(seed=7)
action, _ = policy.predict(observation.numpy())
print(action.shape, policy.description["task"])

assert action.shape == (2, 2, 64, 64)
assert (out / "stage1.safetensors").exists() and (out / "results.json").exists()
folder.cleanup()
