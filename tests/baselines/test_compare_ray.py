"""A comparison on a Ray cluster of two nodes on this machine, of which one dies."""

import json
import os
import threading
from pathlib import Path

import pytest

from baselines.compare.__main__ import main
from cfp.tables import read_table

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Ray's own warnings
ROOT = Path(__file__).parents[2]
NAMES = [f"mpc-shapematch-quick-{seed}" for seed in range(3)]
PLAN = {
    "common": {"particles": 100, "substeps": 1, "num_envs": 1, "eval_every": 0, "checkpoint_every": 1, "log_every": 1},
    "algos": {"mpc": {"grid": 8, "horizon": 3, "commit": 1, "iterations": 20}},
}


@pytest.fixture
def cluster(monkeypatch):
    pytest.importorskip("ray")
    import ray
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    small = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    made = Cluster(initialize_head=True, head_node_args={**small, "include_dashboard": False})
    lost = made.add_node(**small)
    made.wait_for_nodes()
    yield made, lost
    ray.shutdown()
    made.shutdown()


def test_runs_of_a_lost_node_are_finished_elsewhere_and_none_twice(cluster, tmp_path):
    made, lost = cluster
    (tmp_path / "plan.json").write_text(json.dumps(PLAN))
    folders = [tmp_path / "out" / "runs" / name for name in NAMES]

    def kill():
        while sum((folder / "checkpoint" / "state.pt").exists() for folder in folders) < 2:
            if over.wait(0.05):
                return
        killed.append([folder.name for folder in folders if (folder / "results.json").exists()])
        made.remove_node(lost, allow_graceful=False)

    killed: list[list[str]] = []
    over = threading.Event()
    killer = threading.Thread(target=kill)
    killer.start()
    options = f"--algos mpc --seeds 0 1 2 --plan {tmp_path / 'plan.json'} --out {tmp_path / 'out'} --device cpu"
    protocol = "--episodes 1 --particles 100"
    code = main([*options.split(), *protocol.split(), "--executor", "ray", "--address", made.address])
    over.set()
    killer.join()
    assert killed == [[]]  # two runs were under way, none was finished
    assert code == 0
    for folder in folders:
        assert [row["step"] for row in read_table(folder / "progress.csv")] == [str(step) for step in range(1, 31)]
        assert not (folder / ".lock").exists() and not (folder / "error.txt").exists()
    assert sum("resuming" in (folder / "log.txt").read_text() for folder in folders) >= 1
    assert "3 of 3 runs are finished and evaluated." in (tmp_path / "out" / "report.md").read_text()
