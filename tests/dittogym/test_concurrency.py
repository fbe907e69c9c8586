"""Environments in threads and in processes, and copies of them: the same bits as alone."""

import copy
import multiprocessing
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from tiny import TASKS, actions, assert_same_bits, episode, tiny

from torchmpm.native.library import find_compiler

BACKENDS = ["eager", pytest.param("native", marks=pytest.mark.skipif(not find_compiler(), reason="no C++ compiler"))]

#: What a user's program does: it has simulated with all its threads, then starts processes that simulate too.
PROGRAM = """
import sys
import gymnasium
import numpy as np
import torch

import dittogym


def compare(context, backend):
    options = {"particles": 9000, "substeps": 1, "backend": backend}
    here = gymnasium.make_vec("dittogym/run-coarse-v0", 2, "vector_entry_point", **options)
    here.reset(seed=0)
    action = np.ones(here.action_space.shape, np.float32)
    first = here.step(action)
    there = gymnasium.make_vec("dittogym/run-coarse-v0", 2, "async", vector_kwargs={"context": context}, **options)
    there.reset(seed=0)
    second = there.step(action)
    there.close()
    assert np.array_equal(first[0], second[0]), "other pictures"
    assert np.allclose(first[1], second[1], rtol=0, atol=1e-6), "other rewards"
    assert here.step(action)[4]["finite"].all() and torch.get_num_threads() == 3


if __name__ == "__main__":
    torch.set_num_threads(3)
    for backend in ("auto", "eager"):
        compare(sys.argv[1], backend)
"""


@pytest.mark.parametrize("backend", BACKENDS)
def test_environments_in_threads(backend: str) -> None:
    """Eight at once on four threads, of several tasks, each as if it were alone."""
    jobs = [(TASKS[k % 4], k) for k in range(8)]
    alone = [episode(tiny(task, 2, backend=backend), seed) for task, seed in jobs]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda job: episode(tiny(job[0], 2, backend=backend), job[1]), jobs))
    for one, other in zip(together, alone, strict=True):
        assert_same_bits(one, other)


def starts() -> list:
    """Ways to start a process; those that import everything anew take seconds."""
    slow = {"spawn", "forkserver"}
    return [
        pytest.param(m, marks=pytest.mark.slow if m in slow else ()) for m in multiprocessing.get_all_start_methods()
    ]


@pytest.mark.parametrize("context", starts())
def test_environments_in_processes(tmp_path: Path, context: str) -> None:
    """Also forked from a process whose threads have worked: GNU OpenMP would wait for ever for threads left behind."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, "-W", "ignore::DeprecationWarning", str(program), context]
    subprocess.run(command, check=True, timeout=300)


@pytest.mark.parametrize("task", ["grow", "kick"])
@pytest.mark.parametrize("twin", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_copies_go_their_own_way(twin, task: str) -> None:
    """In the middle of an episode; the original may be gone."""
    env, same = tiny(task, 2), tiny(task, 2)
    for e in (env, same):
        e.reset(seed=5)
    drive = actions(env, 3)
    with torch.no_grad():
        env.step(drive[0])
        same.step(drive[0])
        other = twin(env)
        env.step(drive[2])
        del env
        assert_same_bits(other.step(drive[1]), same.step(drive[1]))
        assert_same_bits(other.reset(seed=6), same.reset(seed=6))
