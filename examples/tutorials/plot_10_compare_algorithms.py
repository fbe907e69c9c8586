r"""
Compare algorithms
==================

One command trains every algorithm with every seed, evaluates all policies on the same episodes, and writes a report.
This tutorial compares three that take seconds on SHAPE MATCH: zero actions, random actions, and an action sequence
optimised by gradient descent.
"""

# %%
# Options for single algorithms are given in a JSON file. This one limits the optimisation to 30 iterations with few
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
command += ["--seeds", "0", "1", "--plan", str(plan), "--out", str(out), "--episodes", "3", "--robustness", "none"]

# %%
# ``--dry-run`` lists the runs.


def run(*more: str) -> str:
    """Run the command and return its output."""
    return subprocess.run([*command, *more], check=True, capture_output=True, text=True).stdout


print(run("--dry-run"))

# %%
# Run the comparison. Finished runs are kept, so the same command continues after an interruption.

run()
report = (out / "report.md").read_text()
print("\n## ".join(report.split("\n## ")[:2]))  # up to its first table

# %%
# The report is an HTML page, with tables as CSV files and plots in the same folder. Policies that observe nothing,
# such as a fixed action sequence, are never ranked together with policies that observe the image.

for path in sorted(out.iterdir()):
    print(path.name)
figure, axis = plt.subplots(figsize=(8, 5))
axis.imshow(plt.imread(out / "curves.png"))
axis.axis("off")

# %%
# The tables can be read by any program:

with (out / "returns.csv").open(newline="") as file:
    rows = list(csv.DictReader(file))
for row in rows:
    print(f"{row['algo']:9s} {float(row['mean']):.0f}")
means = {row["algo"]: float(row["mean"]) for row in rows}
folder.cleanup()

assert means["gradient"] > means["zero"] + 50
