"""The source distribution is complete, and a wheel works without a compiler and without the source tree."""

import email
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from torchmpm.native import library

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        library.family() is None or library.find_compiler() is None,
        reason="needs a C++ compiler and a usual processor",
    ),
]
#: Simulates, differentiates, writes a replay, and serves the page to play on.
PROGRAM = """
import torch, dittogym
from torchmpm.native import library
env = dittogym.TorchEnv("run", particles="lite", backend="native", substeps=20)
env.reset(seed=0)
actions = torch.full((1, *env.action_shape), 0.5, requires_grad=True)
observation = env.step(actions)[0]
env.state.x.std().backward()
env.film(lambda seen: actions.detach(), "replay.html", max_steps=2)
import functools, re, threading, urllib.request
from cfp.play.server import Server
from cfp.play.session import Session
server = Server(functools.partial(Session, "run", particles=200), "token", 0)
thread = threading.Thread(target=server.run)
thread.start()
root, _, query = server.address.partition("?")
read = lambda name: urllib.request.urlopen(root + name).read().decode()
for name in re.findall('page/[a-z.]+', read("?" + query)):
    read(name)
assert "class Scene" in read("page/scene.js") and read("page/scene.js") in open("replay.html").read()
server.stop()
thread.join()
print(library.provenance())
print(observation.sum().item(), actions.grad.abs().sum().item() > 0, library.build.cache_info().currsize)
"""


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a release holds, with kernels for this processor only."""
    folder = tmp_path_factory.mktemp("dist")
    environment = {"TORCHMPM_PROCESSORS": str(library.family()), "TORCHMPM_LINKS": "https://example.org/blob/v1"}
    command = [sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, env=os.environ | environment, check=True)
    return folder


def test_source_distribution_is_complete(dist: Path) -> None:
    (file,) = dist.glob("*.tar.gz")
    with tarfile.open(file) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder in ("torchmpm", "dittogym", "cfp", "baselines", "tests", "examples", "benchmarks"):
        sources = {str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob("*.[ch]pp")}
        sources |= {str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob("*.py")}
        assert sources <= names
    assert {"docs/conf.py", "docs/concepts/index.md", "docs/images/hero.png", "Makefile", "setup.py"} <= names


def test_wheel_runs_without_compiler(dist: Path, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")
    (wheel,) = dist.glob("*.whl")
    assert "-py3-none-" in wheel.name
    venv.create(tmp_path / "env", symlinks=True)
    packages = next((tmp_path / "env/lib").glob("*/site-packages"))
    zipfile.ZipFile(wheel).extractall(packages)
    (packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    environment = {"PATH": "", "HOME": str(tmp_path / "home"), "OMP_WAIT_POLICY": "PASSIVE", "NO_PROXY": "127.0.0.1"}
    command = [str(tmp_path / "env/bin/python"), "-c", PROGRAM]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first.startswith(str(packages)) and first.endswith(".so")
    assert re.fullmatch(r"[1-9]\d* True 2", second)  # physics and observation, both in C++
    assert not (tmp_path / "home").exists()  # nothing was compiled


def test_links_of_the_readme_are_absolute(dist: Path) -> None:
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        readme = email.message_from_bytes(archive.read(name)).get_payload()
    links = re.findall(r"\]\(([^)]+)\)", str(readme))
    assert len(links) > 10 and all(link.startswith("https://") for link in links)
    assert "https://example.org/blob/v1/docs/images/tasks.webp?raw=true" in links
