"""The examples of the README and of the docs run as they stand, and keep to the shapes that the annotations promise."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Lets beartype check every annotation of the physics, shapes included, while what follows runs.
CHECKED = """
from jaxtyping import install_import_hook
with install_import_hook("torchmpm", "beartype.beartype"):
    import torchmpm
"""


def examples(page: str) -> str:
    """The Python blocks of a page that need no trained policy, one after the other."""
    text, _, _ = (ROOT / page).read_text().partition("<!-- trained -->")
    return "\n".join(re.findall(r"^```python\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE))


def run(source: str) -> subprocess.CompletedProcess[str]:
    """Run a program in a process of its own: the hook must be there before the first import."""
    return subprocess.run([sys.executable, "-c", source], cwd=ROOT, capture_output=True, text=True)


def test_examples_run_with_checked_annotations() -> None:
    checks = [
        "assert muscles.grad.abs().max() > 0",
        "assert env.observation_space.shape == (3, 64, 64)",
        "assert reward.shape == (16,) and action.grad.flatten(1).norm(dim=1).min() > 0",
    ]
    done = run("\n".join([CHECKED, examples("README.md"), *checks]))
    assert done.returncode == 0, done.stderr


def test_examples_of_ones_own() -> None:
    checks = [
        "assert env.action_space.shape == (2, 4, 4) and env.observation_space.shape == (3, 16, 16)",
        "assert batch.num_envs == 4 and 0 <= action < 8",
        'assert dittogym.make_spec("hop").horizon == 200',
    ]
    done = run("\n".join([CHECKED, examples("docs/own.md"), *checks]))
    assert done.returncode == 0, done.stderr


def test_checked_annotations_notice_a_wrong_shape() -> None:
    done = run(f"{CHECKED}\nimport torch\ntorchmpm.ParticleState.at_rest(torch.zeros(5, 3))")
    assert "TypeCheckError" in done.stderr
