"""What carries out the runs of a comparison; a fake of Ray's interface stands for a cluster, `test_compare_ray` has a
real one."""

import json
import os
import signal
import subprocess
import sys
import time
import types
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from test_compare import COMMON, MPC, PLAN, compare, sessions

from baselines.compare.__main__ import Command, main
from baselines.compare.executor import LocalExecutor, RayExecutor, Resources, execute, run_process
from baselines.compare.final_evaluation import Protocol
from baselines.compare.jobs import Job
from baselines.registry import configure
from cfp.experiment.process import StopSignals
from cfp.tables import read_table

RETRIES = 2
KILLED = "import os; open('count', 'a').write('x'); os.kill(os.getpid(), 9)"
#: Stops with a checkpoint when it is asked to.
PATIENT = (
    "import signal, sys, time\n"
    "signal.signal(signal.SIGTERM, lambda *_: (open('ended', 'w').write('checkpoint'), sys.exit(4)))\n"
    "open('ready', 'w').close(); time.sleep(60)"
)


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A run in this folder; `use_program` says what its process does."""
    monkeypatch.chdir(tmp_path)
    return Job("zero", configure({"algo": "zero"}), tmp_path, Protocol(1))


@pytest.fixture
def use_program(monkeypatch):
    return lambda program: monkeypatch.setattr("baselines.compare.executor.WORKER", (sys.executable, "-c", program))


class FakeRay(types.ModuleType):
    """Tasks in threads, which are retried as Ray retries them: after a loss of their node, or an exception that
    ``retry_exceptions`` lists, ``max_retries`` times in all."""

    class RayError(Exception):
        pass

    class NodeDiedError(RayError):
        pass

    class TaskCancelledError(RayError):
        pass

    def __init__(self, lost_nodes=0):
        super().__init__("ray")
        self.exceptions, self.lost_nodes, self.running = self, lost_nodes, False
        self.pool, self.cancelled = ThreadPoolExecutor(2), set()

    def is_initialized(self):
        return self.running

    def init(self, **_):
        self.running = True

    def shutdown(self):
        self.running = False
        self.pool.shutdown()

    def cancel(self, reference):
        reference.future().cancel()

    def remote(self, function):
        def options(max_retries, retry_exceptions=(), **_):
            def attempt(*arguments):
                for retry in range(1 + max_retries):
                    try:
                        result = function(*arguments)
                        if self.lost_nodes > 0:
                            self.lost_nodes -= 1
                            raise self.NodeDiedError("the node is lost")
                        return result
                    except (self.NodeDiedError, *retry_exceptions):
                        if retry == max_retries:
                            raise

            def submit(*arguments):
                future = self.pool.submit(attempt, *arguments)
                return types.SimpleNamespace(future=lambda: future)

            return types.SimpleNamespace(remote=submit)

        return types.SimpleNamespace(options=options)


def outcomes(executor, *jobs):
    found = []
    execute(executor, jobs, StopSignals(), lambda job, outcome: found.append(outcome))
    return found


@pytest.fixture(params=["local", "ray"])
def executor(request, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    resources = Resources(cpus=1, retries=RETRIES)
    return LocalExecutor(1, resources) if request.param == "local" else RayExecutor(None, resources)


def test_killed_process_is_started_again_and_then_given_up(executor, job, use_program):
    use_program(KILLED)
    assert outcomes(executor, job) == ["failed"]
    assert Path("count").read_text() == "x" * (1 + RETRIES)
    assert "killed by SIGKILL" in Path("error.txt").read_text()


def test_retries_of_ray_and_of_processes_do_not_multiply(job, use_program, monkeypatch):
    """A machine without enough memory loses processes and nodes: both count."""
    counting = (
        "import os; open('count', 'a').write('x'); n = os.stat('count').st_size; n % 2 and os.kill(os.getpid(), 9)"
    )
    use_program(counting)
    monkeypatch.setitem(sys.modules, "ray", FakeRay(lost_nodes=100))
    assert outcomes(RayExecutor(None, Resources(cpus=1, retries=RETRIES)), job) == ["failed"]
    assert Path("count").read_text() == "x" * (1 + RETRIES)


def test_run_of_a_lost_node_is_carried_out_elsewhere(job, use_program, monkeypatch):
    use_program("")
    monkeypatch.setitem(sys.modules, "ray", FakeRay(lost_nodes=RETRIES))
    assert outcomes(RayExecutor(None, Resources(retries=RETRIES)), job) == ["finished"]


@pytest.mark.parametrize(
    ("program", "outcome", "reason"),
    [
        ("", "finished", None),
        ("import sys; sys.exit(3)", "busy", None),
        ("raise ImportError('no such module')", "failed", "ImportError: no such module (exit code 1; see log.txt)\n"),
        ("import os; os._exit(7)", "failed", "no output (exit code 7; see log.txt)\n"),
        ("import sys; open('error.txt', 'w').write('a reason'); sys.exit(1)", "failed", "a reason"),
    ],
)
def test_process_that_fails_leaves_a_reason(executor, job, use_program, program, outcome, reason):
    use_program(program)
    for name in ("error.txt", "log.txt"):
        Path(name).write_text("of an earlier attempt\n")
    assert outcomes(executor, job) == [outcome]
    assert (Path("error.txt").read_text() if Path("error.txt").exists() else None) == reason


@pytest.mark.parametrize(("urgency", "ending"), [(1, "checkpoint"), (2, None)])
def test_process_is_asked_to_stop_before_it_is_killed(job, use_program, urgency, ending):
    use_program(PATIENT)
    assert run_process(job, 1, 0.0, lambda: urgency if Path("ready").exists() else 0) == "stopped"
    assert (Path("ended").read_text() if Path("ended").exists() else None) == ending
    assert not Path("error.txt").exists()


def test_signal_stops_the_runs_in_progress_and_begins_no_other(job, use_program):
    use_program(PATIENT)
    signals, found = StopSignals(), []

    class Watching(LocalExecutor):
        def submit(self, job):
            future = super().submit(job)
            while not Path("ready").exists():
                time.sleep(0.01)
            signals.number = signal.SIGTERM
            return future

    execute(Watching(1, Resources()), [job, job], signals, lambda job, outcome: found.append(outcome))
    assert found == ["stopped", "stopped"] and Path("ended").read_text() == "checkpoint"


def test_error_of_an_executor_is_not_lost(job, monkeypatch, use_program):
    """For instance a full disk, on which not even the reason of a failure can be written."""
    use_program(KILLED)
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    monkeypatch.setattr("baselines.compare.executor.write_text", lambda *_: open("/dev/full/nothing", "w"))
    with pytest.raises(OSError):
        outcomes(RayExecutor(None, Resources(retries=0)), job)


def test_error_of_a_run_stops_the_others_with_a_checkpoint(job, use_program):
    use_program(PATIENT)

    class Failing(LocalExecutor):
        def _run(self, job):
            if job.label != "broken":
                return super()._run(job)
            while not Path("ready").exists():
                time.sleep(0.01)
            raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        outcomes(Failing(2, Resources(cpus=1)), job, replace(job, label="broken"))
    assert Path("ended").read_text() == "checkpoint"


def test_cancelled_task_of_ray_is_stopped(job, monkeypatch):
    ray = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    executor, cancelled = RayExecutor(None, Resources()), Future()
    executor._task = types.SimpleNamespace(remote=lambda *_: types.SimpleNamespace(future=lambda: cancelled))
    ray.cancel = lambda reference: reference.future().set_exception(ray.TaskCancelledError())
    signals, found = StopSignals(), []
    signals.number = signal.SIGINT
    execute(executor, [job], signals, lambda job, outcome: found.append(outcome))
    assert found == ["stopped"] and not ray.running


def test_missing_ray_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert compare(tmp_path / "out", "--algos", "mpc", "--seeds", "0", "--executor", "ray") == 2
    assert "pip install 'torchmpm[ray]'" in capsys.readouterr().err


@pytest.mark.slow  # test_compare.py interrupts a comparison within this process
def test_comparison_that_is_killed_is_resumed(tmp_path):
    """The parent dies without a word: the run stops with a checkpoint, from which the next command continues."""
    slow = {**MPC, "planner": {"horizon": 3, "commit": 1, "iterations": 10}, "report": {"checkpoint_every": 1}}
    plan, out = {**PLAN, "algos": {"mpc": slow}}, tmp_path / "out"
    path = tmp_path / "out.json"
    path.write_text(json.dumps(plan))
    command = [*COMMON, "--out", str(out), "--plan", str(path), "--algos", "mpc", "--seeds", "0", "--workers", "1"]
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    parent = subprocess.Popen([sys.executable, "-m", "baselines.compare", *command], env=environment, cwd=tmp_path)
    folder, end = out / "runs" / "mpc-shapematch-quick-0", time.monotonic() + 120
    while not (folder / "checkpoint" / "state.pt").exists():
        assert parent.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    while not (folder / "sessions.json").exists():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert main([*command[:-2], "--workers", "0"]) == 0
    first, second = sessions(out, folder.name)
    assert 0 < first["to"] == second["from"] < second["to"] == 30
    assert not first["finished"] and second["finished"]
    assert [row["step"] for row in read_table(folder / "progress.csv")] == ["10", "20", "30"]


def test_the_worker_of_a_comparison_carries_out_a_run(tmp_path):
    """As by default: a process of its own, with the real program."""
    config = configure({"algo": "zero", "environment": {"particles": 100, "substeps": 1}})
    job = Job("zero", config, tmp_path / "run", Protocol(1, 100, "none"))
    assert outcomes(LocalExecutor(1, Resources(cpus=1)), job) == ["finished"]
    assert job.trained and not job.error


@pytest.mark.parametrize("cpus", [3, None])
def test_a_worker_has_its_share_of_the_cores(job, use_program, cpus, monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(4)))
    use_program("import os; open('threads', 'w').write(os.environ['OMP_NUM_THREADS'])")
    outcomes(LocalExecutor(2, Resources(cpus=cpus)), job)
    assert int(Path("threads").read_text()) == (cpus or 2)


def test_the_command_line_says_how_runs_are_carried_out():
    command = Command(cpus_per_run=3, retries=1, noise="with")
    resources = command.make_executor(StopSignals()).resources
    assert (resources.cpus, resources.retries, command.final_protocol.noise) == (3, 1, "with")
