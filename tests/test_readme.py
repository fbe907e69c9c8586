"""The code samples of the README and the documentation run, and pass the shape checks of the annotations."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Makes beartype check all annotations of the physics, including shapes, while the samples run.
CHECKED = """
from jaxtyping import install_import_hook
with install_import_hook("torchmpm", "beartype.beartype"):
    import torchmpm
import torch
try:
    torchmpm.ParticleState.at_rest(torch.zeros(5, 3))
except Exception as error:
    assert type(error).__name__ == "TypeCheckError", error
else:
    raise AssertionError("annotations are not checked")
del torch  # the samples import what they use
"""


def examples(page: str) -> str:
    """All Python blocks of a page, joined."""
    text = (ROOT / page).read_text()
    return "\n".join(re.findall(r"^```python\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE))


def run(source: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program in a folder, in a new process because the hook must precede the first import."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, "-c", source], cwd=folder, env=environment, capture_output=True, text=True)


PAGES = {
    "README.md": (
        "import os\nassert os.path.getsize('grow.html') > 100_000",
        "assert env.observation_space.shape == (3, 64, 64)",
        "assert reward.shape == (16,) and actions.grad.flatten(1).norm(dim=1).min() > 0",
    ),
    "docs/start.md": (
        "import os\nassert os.path.getsize('moving.html') > 100_000",
        "assert info['displacement'].item() > 0.2",
    ),
    "docs/custom-tasks.md": (
        "assert small.action_space.shape == (2, 4, 4) and small.observation_space.shape == (3, 16, 16)",
        "assert best in range(8) and action.grad.flatten(1).norm(dim=1).min() > 0",
        "batch.reset(seed=0)\n_, first, *_ = batch.step(torch.zeros(2, *batch.action_shape))\nassert first.max() <= 0",
        'assert dittogym.make_spec("hop").horizon == 20 and policy.description["task"] == "hop"',
    ),
    "docs/does-it.md": (
        "assert observation.shape == (100, 4) and abs(observation[:, :2].mean(0)).max() < 1e-6",
        "from gymnasium.utils.env_checker import check_env",
        "check_env(Particles(gymnasium.make('dittogym/run-coarse-v0', **quick)), skip_render_check=True)",
        "import stable_baselines3",
        "raced = Particles(gymnasium.make('dittogym/run-coarse-v0', **quick))",
        "stable_baselines3.PPO('MlpPolicy', raced, n_steps=8, batch_size=8, device='cpu').learn(8)",
        "assert left.std(0).max() < 0.97 * right.std(0).min()",
        "env = gymnasium.make('dittogym/run-coarse-v0', particles=300)",
        "env.reset(seed=0, options={'physics': {'gravity': uphill}})",
        "for _ in range(50): *_, info = env.step(np.zeros(env.action_space.shape, np.float32))",
        "assert info['displacement'] < -0.005",  # on even ground a robot at rest moves by less than a millimetre
    ),
    "docs/films.md": (
        "from PIL import Image\nassert Image.open('star.webp').n_frames > 50 and Image.open('star.png').height == 256",
        "assert len(recording.rewards) == 30 and sum(recording.rewards) > 300",
    ),
    "docs/concepts/gradients.md": (
        "assert gradient.abs().max() > 0",
        "assert (log_young.exp() - 4e4).abs().max() < 10",
    ),
    "docs/concepts/planning.md": ("assert planner.num_plans > 0 and planner.num_failed == 0",),
    "docs/develop/adding.md": (
        "assert width > 2 * start.x[..., 0].std() and bulk.grad.abs() > 0",
        "assert net[0].weight.grad.abs().max() > 0 and friction.grad < 0",
        "assert (slid.x - start.x)[..., 0].mean() < -0.005 and angle.grad < 0",
        "assert policy.actions.shape == (30, 2, 32, 32) and (folder / 'index.html').exists()",
    ),
}


#: The others take up to a minute; README.md does some of the same in less time.
FAST = {"README.md"}


@pytest.mark.parametrize("page", [pytest.param(p, marks=[pytest.mark.slow] * (p not in FAST)) for p in PAGES])
def test_examples_run_with_checked_annotations(page: str, tmp_path: Path) -> None:
    done = run("\n".join([CHECKED, examples(page), *PAGES[page]]), tmp_path)
    assert done.returncode == 0, done.stderr
