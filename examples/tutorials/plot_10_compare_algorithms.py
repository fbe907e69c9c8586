r"""
Compare algorithms
==================

One command trains every algorithm with every seed, judges all policies on the same layouts, and writes a report. Here
it gets three that take seconds: slack muscles, random actions, and a sequence of actions by gradient, all on SHAPE
MATCH.
"""

# %%
# Options of single algorithms come from a small file. This one cuts the gradient's work down to thirty iterations
# with few particles.

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

folder = tempfile.TemporaryDirectory()
out, plan = Path(folder.name) / "compare", Path(folder.name) / "plan.json"
quick = {"iterations": 30, "tier": 500, "grid": 8, "learning_rate": 0.1}
plan.write_text(json.dumps({"algos": {"gradient": quick}}))
command = [sys.executable, "-m", "baselines.compare", "--tasks", "shapematch", "--algos", "zero", "random", "gradient"]
command += ["--seeds", "0", "1", "--plan", str(plan), "--out", str(out), "--episodes", "3", "--robustness", "none"]

# %%
# ``--dry-run`` lists what there is to do.


def run(*more: str) -> str:
    """What the command prints."""
    return subprocess.run([*command, *more], check=True, capture_output=True, text=True).stdout


print(run("--dry-run"))

# %%
# Then for real. What is finished is kept: the same command again would train nothing, and after an interruption it
# goes on where it was.

run()
report = (out / "report.md").read_text()
print(report[: report.index("##", report.index("## ") + 3)])

# %%
# The report is a page that opens from disk, with tables as CSV and pictures beside it. A policy that knows nothing
# but the time, such as the gradient's, is never ranked with those that look at the image.

for path in sorted(out.iterdir()):
    print(path.name)
figure, axis = plt.subplots(figsize=(8, 5))
axis.imshow(plt.imread(out / "curves.png"))
axis.axis("off")

# %%
# The numbers, as any program would read them:

lines = (out / "returns.csv").read_text().splitlines()
columns = lines[0].split(",")
rows = [dict(zip(columns, line.split(","), strict=False)) for line in lines[1:]]
for row in rows:
    print(row["algo"], row["mean"])
means = {row["algo"]: float(row["mean"]) for row in rows}
folder.cleanup()

assert means["gradient"] > means["zero"] + 50
