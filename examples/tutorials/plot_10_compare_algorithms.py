r"""
Compare algorithms
==================

One command trains every algorithm with every seed, evaluates all policies on the same episodes, and writes a report.
This tutorial compares three that take seconds on SHAPE MATCH: zero actions, random actions, and an action sequence
optimised by gradient descent.
"""

# %%
# Options for individual algorithms are given in a JSON file. This one limits the optimisation to 30 iterations with few
# particles.

import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

folder = tempfile.TemporaryDirectory()
out, plan = Path(folder.name) / "compare", Path(folder.name) / "plan.json"
quick = {"iterations": 30, "train_particles": 500, "grid": 8, "learning_rate": 0.1}
plan.write_text(json.dumps({"algos": {"gradient": quick}}))
command = [sys.executable, "-m", "baselines.compare", "--tasks", "shapematch", "--algos", "zero", "random", "gradient"]
command += ["--seeds", "0", "1", "--plan", str(plan), "--out", str(out), "--episodes", "3"]

# %%
# ``--dry-run`` lists the runs with the command lines of their trainings.


def run(*more: str) -> str:
    """Run the command and return its output."""
    return subprocess.run([*command, *more], check=True, capture_output=True, text=True).stdout


print(run("--dry-run"))

# %%
# Run the comparison. Finished runs are kept, so the same command continues after an interruption.

run()
print((out / "report.md").read_text())

# %%
# The report is an HTML page; its table is also in Markdown, and its picture shows learning curves and returns. Compare
# only policies that observe the same: a fixed action sequence observes nothing, like zero and random actions.

for path in sorted(out.iterdir()):
    print(path.name)
figure, axis = plt.subplots(figsize=(10, 4))
axis.imshow(plt.imread(out / "returns.png"))
axis.axis("off")

# %%
# Every episode is a row of a table that any program can read:

with (out / "episodes.csv").open(newline="") as file:
    rows = list(csv.DictReader(file))
means = {}
for name in ("zero", "random", "gradient"):
    returns = [float(row["return"]) for row in rows if row["algorithm"] == name]
    means[name] = sum(returns) / len(returns)
    print(f"{name:9s} {means[name]:.0f}")
folder.cleanup()

assert means["gradient"] > means["zero"] + 50
