"""The scripts of the documentation's page on other libraries run, where these are installed."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: What each script prints, and the modules that it needs.
SCRIPTS = {
    "sb3_ppo": (r"64 steps, 4 returns, actions \(2, 2, 8, 8\)", "stable_baselines3"),
    "sb3_contrib_tqc": (r"16 steps, [1-9]\d* updates, actions \(2, 2, 8, 8\)", "sb3_contrib"),
    "ppo_torch": (r"iteration 2: mean reward -?\d", "torch"),
    "torchrl_gym_env": (r"5 steps, images \(5, 3, 64, 64\), actions \(5, 2, 8, 8\)", "torchrl"),
    "rllib_ppo": (r"64 steps, loss of the policy -?\d", "ray tree"),
    "optuna_study": (r"0\.\d+ m with \{'frequency'", "optuna"),
    "optuna_pruning": (r"\d of 6 trainings pruned; best return -?\d", "optuna"),
    "async_vector_env": (r"fork: rewards (.*)\nforkserver: rewards \1\nspawn: rewards \1", "torch"),
    "func_transforms": (r"width per Pa: -\d", "torch"),
    "checkpoint_steps": (r"gradients \(4, 1, 2, 8, 8\) are equal, norm \d", "torch"),
}
#: The others start many processes, import much, or compute for several seconds.
FAST = {"sb3_ppo"}


def test_every_script_is_tested_and_shown() -> None:
    page = (ROOT / "docs/tasks.md").read_text()
    scripts = {path.stem for path in (ROOT / "examples/clients").glob("*.py")}
    assert scripts == set(SCRIPTS) == set(re.findall(r"\]\(\.\./examples/clients/(\w+)\.py", page))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in FAST)) for n in SCRIPTS])
def test_script_runs(name: str, tmp_path: Path) -> None:
    expected, modules = SCRIPTS[name]
    for module in modules.split():
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / f"examples/clients/{name}.py")]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search(expected, done.stdout), done.stdout
