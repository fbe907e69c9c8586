"""What the library does on a GPU, in at most eight minutes: does it run, is it right, how fast is it, does it train?

`make gpu` runs it. The stages are processes of their own with a time limit each. Results are written after every check,
a failure is recorded and passed over, and a short table comes last. On a GPU they go to
`benchmarks/gpu/CARD-DATE.json`, from which `docs/tables.py` makes the tables of the documentation. Without a GPU the
same stages run with tiny sizes on the imitation of the kernels that the tests use, and the results go to a temporary
folder.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import io
import json
import math
import multiprocessing
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, nullcontext, redirect_stdout
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/gpu"
#: Seconds of each stage; the last one takes what is left.
LIMITS = {"card": 60, "tests": 90, "parity": 50, "speed": 90, "paper": 20, "training": 130, "curve": 600}
#: Exit code of a stage whose GPU context is lost, after which no further check of the process could run.
LOST = 77
#: Calls before a measurement: the first compiles, and the third step of an environment is recorded as a CUDA graph.
WARM_UP = 3
#: Steps a second of the environment of RUN at full size in the paper, on an RTX 4090.
PAPER_SPEED = 70.1

#: Differences between float32 and float64 on a CPU, largest of two lite robots: after one environment step in position
#: (m), velocity (m/s) and deformation, after 20 in position, velocity and the reward of a step, and of the gradient
#: after one and three steps, relative. Ten times these are allowed.
DIFFERENCES = {
    "run": {"x": 3e-7, "v": 7e-6, "F": 2e-6, "x20": 2e-6, "v20": 1e-4, "reward": 3e-5, "g1": 5e-6, "g3": 2e-5},
    "catch": {"x": 7e-7, "v": 2e-5, "F": 7e-6, "x20": 3e-6, "v20": 5e-4, "reward": 3e-5, "g1": 1e-6, "g3": 5e-6},
    "dig": {"x": 7e-7, "v": 7e-4, "F": 1e-4, "x20": 2e-5, "v20": 7e-4, "reward": 5e-4, "g1": 3e-4, "g3": 3e-3},
}
#: The same for float64 on the GPU, as it is allowed.
EXACT = {"x": 1e-9, "v": 1e-9, "F": 1e-9, "g1": 1e-7}

#: Distance from a whole number below which a value of the picture may be rounded down to either of two bytes. Objects
#: at rest have such values: zero velocity is 132.
EDGE = 0.05

Figures = dict[str, Any]
Check = tuple[str, Callable[[], Figures]]


@dataclass(frozen=True)
class Lab:
    """Where the checks run, and how large they are."""

    device: str  # of the tensors
    tiny: bool  # sizes for the imitation
    scratch: Path  # the references, and the folders of trainings
    seconds: float  # that the stage may take

    @property
    def options(self) -> dict[str, Any]:
        """Of environments that check numbers."""
        return {"particles": 60, "substeps": 3} if self.tiny else {"particles": "lite"}

    def env(self, task: str, num_envs: int, **options: Any) -> Any:
        """An environment that is ready to step."""
        import dittogym

        env = dittogym.TorchEnv(task, num_envs, **{"device": self.device, **self.options, **options})
        env.reset(seed=0)
        return env

    def wait(self) -> None:
        """For the GPU."""
        if self.device == "cuda":
            torch.cuda.synchronize()

    def rate(self, call: Callable[[], object], units: float, seconds: float = 1.5) -> float:
        """Units a second of calls, of which each does some; up to 200, and one synchronisation at the end."""
        for _ in range(WARM_UP):
            call()
        self.wait()
        start = time.perf_counter()
        call()
        self.wait()
        calls = max(2, min(200, int(seconds / (time.perf_counter() - start))))
        start = time.perf_counter()
        for _ in range(calls):
            call()
        self.wait()
        return calls * units / (time.perf_counter() - start)


# What checks share


def backend_of(env: Any) -> str:
    """The backend that an environment's physics runs on."""
    return "native" if env.model.solver.runs_native(env.state) else "eager"


def actions(env: Any, step: int) -> Tensor:
    """The same random actions on every device and in every precision."""
    drawn = torch.rand(env.num_envs, *env.action_shape, generator=torch.Generator().manual_seed(step))
    return (2 * drawn - 1).to(env.device, env.dtype)


def rollout(env: Any, steps: int, gradient: bool = False) -> dict[str, Tensor]:
    """State and observation at the end, the rewards, and the gradient of the smooth ones in the first action."""
    first, rewards = actions(env, 0).requires_grad_(gradient), []
    with torch.set_grad_enabled(gradient):
        for k in range(steps):
            observation, reward, *_ = env.step(first if k == 0 else actions(env, k), soft=gradient)
            rewards.append(reward)
    found = {"x": env.state.x, "v": env.state.v, "F": env.state.F, "reward": torch.stack(rewards)}
    if gradient:
        found["gradient"] = torch.autograd.grad(found["reward"].sum(), first)[0]
    else:
        found |= {"observation": observation, "levels": levels(env)}
    return {name: tensor.detach().double().cpu() for name, tensor in found.items()}


def levels(env: Any) -> Tensor:
    """The present observation before it is rounded down."""
    state = env.env_state
    shown: Tensor = env.model.camera.levels(state.particles.x, state.particles.v, state.origin, state.centre)
    return shown


def judged(figures: Figures, bounds: dict[str, float]) -> Figures:
    """Figures with what is wrong about them: those that are not within their bounds."""
    wrong = [
        f"{name} {figures[name]:.1e} > {bound:.0e}" for name, bound in bounds.items() if not figures[name] <= bound
    ]
    return figures | {"wrong": wrong}


def largest(one: Tensor, other: Tensor) -> float:
    """The largest difference."""
    return float((one - other).abs().max())


def relative(one: Tensor, other: Tensor) -> float:
    """Length of the difference in units of the other's length."""
    return float((one - other).norm() / other.norm())


# Stage 0: the card


def card(lab: Lab) -> Iterator[Check]:
    """Versions, and rates that bound what kernels can do."""
    yield "versions", versions
    if not lab.tiny:
        yield "compilation", compile_all
        yield "copies", lambda: copies(lab)
        yield "launches", lambda: launches(lab)
        yield "additions", lambda: additions(lab)


def versions() -> Figures:
    """Of what the results depend on."""
    import gymnasium
    import stable_baselines3

    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout
    found = {
        "torch": torch.__version__,
        "gymnasium": gymnasium.__version__,
        "stable-baselines3": stable_baselines3.__version__,
        "commit": commit.strip(),
    }
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(0)
        found |= {"card": properties.name, "memory (GB)": round(properties.total_memory / 1e9, 1)}
        found |= {"multiprocessors": properties.multi_processor_count, "CUDA": torch.version.cuda}
    return found


def compile_all() -> Figures:
    """Compile the kernels of the other stages, side by side, so that they find them on disk."""
    from benchmarks.cuda_kernels import launches
    from torchmpm.native.cuda.compiler import compile_kernel

    major, minor = torch.cuda.get_device_capability()
    kernels = list({one.kernel for _, one in launches()})
    start = time.perf_counter()
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 16), multiprocessing.get_context("spawn")) as pool:
        list(pool.map(compile_kernel, kernels, [f"sm_{major}{minor}"] * len(kernels)))
    return {"kernels": len(kernels), "seconds": time.perf_counter() - start}


def copies(lab: Lab) -> Figures:
    """Bandwidth of the memory, bytes read and written."""
    one = torch.empty(2**28, device=lab.device)
    other = torch.empty_like(one)
    return {"GB/s": lab.rate(lambda: other.copy_(one), 2 * 4 * one.numel() / 1e9, 0.5)}


def launches(lab: Lab) -> Figures:
    """Time of a small operation of torch, of which a step without kernels has tens of thousands."""
    small = torch.zeros(8, device=lab.device)
    return {"µs/operation": 1e6 / lab.rate(lambda: [small.add_(1.0) for _ in range(100)], 100, 0.5)}


#: Each thread adds to places that spread over a window of nodes, as particles do.
ADDITIONS = r"""
struct Arguments { float* at; int rounds; };

template <class T, class Add> __device__ void repeat(T* nodes, int rounds, Add one) {
    for (int k = 0; k < rounds; ++k) atomicAdd(nodes + ((threadIdx.x + 37 * k) * 2654435761u >> 8) % 2304, one);
}

template <class T> __device__ void in_shared_memory(const Arguments& a) {
    __shared__ T nodes[2304];
    for (int i = threadIdx.x; i < 2304; i += blockDim.x) nodes[i] = 0;
    __syncthreads();
    repeat(nodes, a.rounds, T(1));
    __syncthreads();
    if (threadIdx.x < 4) a.at[threadIdx.x] += float(nodes[threadIdx.x]);
}

extern "C" __global__ void global_one(Arguments a) { repeat(a.at + blockIdx.x * 9216, a.rounds, 1.0f); }
extern "C" __global__ void global_four(Arguments a) {
#if __CUDA_ARCH__ >= 900
    repeat((float4*)a.at + blockIdx.x * 2304, a.rounds, float4{1.0f, 1.0f, 1.0f, 1.0f});
#endif
}
extern "C" __global__ void shared_float(Arguments a) { in_shared_memory<float>(a); }
extern "C" __global__ void shared_int(Arguments a) { in_shared_memory<int>(a); }
"""


def additions(lab: Lab) -> Figures:
    """Atomic additions in global memory, of one and of four numbers, and in shared memory, 10^9 a second."""
    from torchmpm.native.cuda.compiler import compile_source
    from torchmpm.native.cuda.driver import Cuda, Launch

    class Arguments(ctypes.Structure):
        _fields_ = [("at", ctypes.c_void_p), ("rounds", ctypes.c_int)]

    driver, device = Cuda(), torch.device("cuda", torch.cuda.current_device())
    major, minor = torch.cuda.get_device_capability()
    binary, threads, rounds = compile_source(ADDITIONS, f"sm_{major}{minor}", {}), 512, 1000
    blocks = torch.cuda.get_device_properties(device).multi_processor_count
    room, found = torch.zeros(blocks * 9216, device=lab.device), {}
    arguments = Arguments(room.data_ptr(), rounds)
    for name in ("global_one", "global_four", "shared_float", "shared_int"):
        if name != "global_four" or major >= 9:
            launch = partial(driver.launch, driver.function(binary, name, device), Launch(blocks, threads))
            rate = lab.rate(partial(launch, arguments, device), blocks * threads * rounds / 1e9, 0.3)
            found[f"{name} (G/s)"] = rate
    return found


# Stage 1: the tests


def tests(lab: Lab) -> Iterator[Check]:
    """Those marked cuda, in parallel processes; of the imitation one file, as the others run in `make test`."""
    yield "tests marked cuda", lambda: run_tests(lab)


def run_tests(lab: Lab) -> Figures:
    """How many passed, and the names of those that failed; warnings of other versions of packages are no failures."""
    chosen = ["-m", "not slow and not cuda", "tests/torchmpm/test_cuda_driver.py"]
    if not lab.tiny:  # other files may need packages that are not here
        files = [str(path) for path in sorted((ROOT / "tests").rglob("test_*.py")) if "mark.cuda" in path.read_text()]
        chosen = ["-m", "cuda", *files]
    processes = ["-n", str(min(8, os.cpu_count() or 1))] if find_spec("xdist") and not lab.tiny else []
    options = ["-v", "-rf", "-p", "no:cacheprovider", "-W", "default", *processes]
    command = [sys.executable, "-m", "pytest", *options, *chosen]
    with tempfile.TemporaryFile("w+") as output:
        try:
            code = subprocess.run(
                command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, timeout=lab.seconds - 10
            ).returncode
        except subprocess.TimeoutExpired:
            code = None
        output.seek(0)
        text = output.read()
    failed = list(dict.fromkeys(re.findall(r"(?:FAILED|ERROR) (tests/\S+)", text)))
    wrong = failed or ([] if code == 0 else [f"pytest ended with {code}: {text[-300:]}"])
    return {"summary": text.strip().splitlines()[-1] if text.strip() else "", "wrong": wrong}


# Stage 2: parity


def write_references(lab: Lab) -> None:
    """What the checks compare with: float64 on the CPU, a file for each task, beside the first stages."""
    for task in DIFFERENCES:
        found = {}
        for steps, gradient in ((1, False), (20, False), (1, True), (3, True)):
            env = lab.env(task, 2, device="cpu", dtype="float64")
            found[steps, gradient] = rollout(env, min(steps, 3) if lab.tiny else steps, gradient)
        path = lab.scratch / f"{task}.pt"
        torch.save(found, path.with_suffix(".part"))
        os.replace(path.with_suffix(".part"), path)


def reference(lab: Lab, task: str) -> dict[tuple[int, bool], dict[str, Tensor]]:
    """The reference of a task, once it is there."""
    path, end = lab.scratch / f"{task}.pt", time.monotonic() + lab.seconds
    while not path.exists():
        if time.monotonic() > end or (lab.scratch / "no-references").exists():
            raise RuntimeError("the references were not made")
        time.sleep(0.2)
    return torch.load(path, weights_only=True)


def parity(lab: Lab) -> Iterator[Check]:
    """The numbers of the CPU, and what has to hold on a GPU besides."""
    yield "gradients of soil are finite", lambda: soil(lab)
    yield "a batch equals its elements", lambda: elements(lab)
    yield "a broken robot harms no other", lambda: broken(lab)
    yield "a run repeats", lambda: repeated(lab)
    if not lab.tiny:
        yield "two streams", lambda: streams(lab)
    yield "memory stays flat", lambda: memory(lab)
    for task in DIFFERENCES:  # last, as the references may be late
        yield f"{task}, float32", lambda task=task: compare(lab, task, "float32")
        yield f"{task}, float64", lambda task=task: compare(lab, task, "float64")


def compare(lab: Lab, task: str, dtype: str) -> Figures:
    """States, rewards, observations and gradients of two robots against the reference."""
    expected, known = reference(lab, task), DIFFERENCES[task]
    env = lab.env(task, 2, dtype=dtype)
    found = {"backend": backend_of(env)}
    one = rollout(env, 1)
    found |= {name: largest(one[name], expected[1, False][name]) for name in ("x", "v", "F")}
    many = rollout(lab.env(task, 2, dtype=dtype), 3 if lab.tiny else 20)
    found |= {f"{name}20": largest(many[name], expected[20, False][name]) for name in ("x", "v")}
    found["reward"] = largest(many["reward"], expected[20, False]["reward"])
    differs, exact = (one["observation"] - expected[1, False]["observation"]).abs(), expected[1, False]["levels"]
    gap = (exact - exact.round()).abs()
    clear = (gap == 0) | (gap > EDGE)
    found |= {"levels": float(differs.max()), "pixels (%)": 100 * float(((differs > 0) & clear).double().mean())}
    for steps in (1, 3):
        gradient = rollout(lab.env(task, 2, dtype=dtype), steps, gradient=True)["gradient"]
        found[f"g{steps}"] = relative(gradient, expected[steps, True]["gradient"])
    bounds = EXACT if dtype == "float64" else {name: 10 * difference for name, difference in known.items()}
    return judged(found, bounds | {"levels": 1, "pixels (%)": 0.1})


def soil(lab: Lab) -> Figures:
    """DIG's in float32: after some steps most grains have strains whose squares are denormal."""
    steps = {}
    for count in (1, 2, 3):
        env = lab.env("dig", 2, dtype="float32")
        rollout(env, 1 if lab.tiny else 20)
        steps[f"not finite in {count}"] = int((~rollout(env, count, gradient=True)["gradient"].isfinite()).sum())
    return judged({"backend": backend_of(env)} | steps, dict.fromkeys(steps, 0))


def elements(lab: Lab) -> Figures:
    """Robots of a batch against the same robots alone, and whether they are equal to the last bit."""
    import dittogym

    count, steps = (3, 1) if lab.tiny else (8, 3)
    env = lab.env("run", count)
    together, action = rollout(env, steps), {k: actions(env, k) for k in range(steps)}
    worst = 0.0
    for index in (0, count - 1):
        alone = dittogym.TorchEnv("run", 1, device=lab.device, **lab.options)
        alone.reset(seed=index)
        with torch.no_grad():
            for k in range(steps):
                alone.step(action[k][index : index + 1])
        worst = max(worst, largest(together["x"][index], alone.state.x[0].double().cpu()))
    return judged({"backend": backend_of(env), "x": worst, "equal bits": worst == 0}, {"x": 3e-6})


def broken(lab: Lab) -> Figures:
    """The others of a batch in which one robot's positions are NaN and another's are beyond the window."""
    ends = []
    for breaks in (False, True):
        env = lab.env("run", 4)
        if breaks:
            x = env.state.x.clone()
            x[1], x[2] = math.nan, 1e30
            env.env_state = replace(env.env_state, particles=replace(env.state, x=x))
        ends.append(rollout(env, 1)["x"][[0, 3]])
    return judged({"backend": backend_of(env), "x": largest(*ends)}, {"x": 0})


def repeated(lab: Lab) -> Figures:
    """Two runs: forward bit for bit the same; gradients are added up in no fixed order."""
    states = [rollout(lab.env("run", 4), 1 if lab.tiny else 5)["x"] for _ in range(2)]
    found = [rollout(lab.env("run", 4), 1, gradient=True)["gradient"] for _ in range(2)]
    env = lab.env("run", 1)
    return judged({"backend": backend_of(env), "x": largest(*states), "gradient": relative(*found)}, {"x": 0})


def streams(lab: Lab) -> Figures:
    """Steps of two environments on two streams at once, against one after the other."""
    alone = [rollout(lab.env(task, 16), 3)["x"] for task in ("run", "catch")]
    pairs = [(lab.env(task, 16), torch.cuda.Stream()) for task in ("run", "catch")]
    lab.wait()
    with torch.no_grad():
        for k in range(3):
            for env, stream in pairs:
                with torch.cuda.stream(stream):
                    env.step(actions(env, k))
    lab.wait()
    worst = max(largest(env.state.x.double().cpu(), x) for (env, _), x in zip(pairs, alone, strict=True))
    return judged({"backend": backend_of(pairs[0][0]), "x": worst}, {"x": 0})


def memory(lab: Lab) -> Figures:
    """Growth of the memory from step 10 to step 50, without gradients and with those of every step."""
    found: Figures = {}
    for gradient in (False, True):
        env, used = lab.env("run", 2 if lab.tiny else 64), []
        for k in range(4 if lab.tiny else 50):
            action = actions(env, k).requires_grad_(gradient)
            with torch.set_grad_enabled(gradient):
                reward = env.step(action, soft=gradient)[1]
            if gradient:
                torch.autograd.grad(reward.sum(), action)
                env.detach()
            used.append(torch.cuda.memory_allocated() / 1e6 if lab.device == "cuda" else 0.0)
        name = f"growth (MB){', with gradients' * gradient}"
        found |= {"backend": backend_of(env), name: used[-1] - used[min(10, len(used) - 1)]}
    return judged(found, {name: 1.0 for name in found if name != "backend"})


# Stage 3: speed


def speed(lab: Lab) -> Iterator[Check]:
    """Of the physics alone and of whole environment steps, forward and with gradients."""
    sizes = ((1, "full"), (1, "lite"), (64, "lite"), (256, "lite"), (1024, "lite"), (4096, "lite"))
    for count, particles in ((1, 60), (2, 30)) if lab.tiny else sizes:
        yield f"{count} × {particles}", lambda n=count, p=particles: measure(lab, n, p, "auto")
    for task in ("run",) if lab.tiny else ("run", "shapematch", "dig"):
        yield f"launches of a step of {task}", lambda task=task: count_launches(lab, task)
    for count in (1,) if lab.tiny else (1, 1024):  # last, as a step may take seconds
        particles = 30 if lab.tiny else "lite"
        yield f"{count} × {particles}, eager", lambda n=count, p=particles: measure(lab, n, p, "eager")


def measure(lab: Lab, count: int, particles: Any, backend: str) -> Figures:
    """Environment steps a second of all robots together; peak memory of the gradient."""
    env, slow = lab.env("run", count, particles=particles, backend=backend), backend == "eager"
    with torch.no_grad():
        env.step(actions(env, 0))
    solver, state, substeps = env.model.solver, env.state, env.model.substeps
    origin, nodes = env.env_state.origin, solver.grid.resolution
    field = torch.zeros(count, 2, nodes, nodes, dtype=env.dtype, device=env.device)
    action, seconds = actions(env, 1), 0.1 if lab.tiny else 1.0
    found: Figures = {"backend": backend_of(env), "particles": solver.num_particles}

    def advance() -> Any:
        return solver.step(state, field, substeps=substeps, origin=origin)

    def differentiate() -> None:
        torch.autograd.grad(advance().x.square().sum(), field)

    with torch.no_grad():
        found["physics (steps/s)"] = lab.rate(advance, count, seconds)
        found["particle-substeps/s"] = found["physics (steps/s)"] * solver.num_particles * substeps
        if slow:
            return found
        found["env.step (steps/s)"] = lab.rate(lambda: env.step(action), count, seconds)
    field.requires_grad_()
    if lab.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    found["physics with gradient (steps/s)"] = lab.rate(differentiate, count, seconds)
    if lab.device == "cuda":
        found["peak memory (GB)"] = torch.cuda.max_memory_allocated() / 1e9
    action.requires_grad_()

    def learn() -> None:
        torch.autograd.grad(env.step(action, soft=True)[1].sum(), action)
        env.detach()

    found["env.step with gradient (steps/s)"] = lab.rate(learn, count, seconds)
    return found


def count_launches(lab: Lab, task: str) -> Figures:
    """Kernels of an environment step that is replayed, and where it waits for the GPU."""
    from dittogym import observation

    env = lab.env(task, 2 if lab.tiny else 256)
    action, found = actions(env, 0), {"backend": backend_of(env)}
    with torch.no_grad():
        for _ in range(WARM_UP):
            env.step(action)
        drawing = observation._drawing(env.model.camera, env.dtype, env.device)
        reasons = [env._replayed and env._replayed.failure, drawing if isinstance(drawing, str) else None]
        found["wrong"] = [f"falls back: {reason}" for reason in reasons if reason]
        if lab.device != "cuda":
            return found
        import warnings

        from torch.profiler import ProfilerActivity, profile

        torch.cuda.set_sync_debug_mode("warn")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            env.step(action)
        torch.cuda.set_sync_debug_mode("default")
        with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as recorded:
            env.step(action)
            lab.wait()
    events = [e for e in recorded.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    longest = sorted(events, key=lambda e: -e.device_time_total)[:6]
    found["kernels"] = sum(e.count for e in events)
    found["waits"] = sorted({f"{Path(w.filename).name}:{w.lineno}" for w in caught})
    found["longest (ms)"] = {e.key[:60]: round(e.device_time_total / 1e3, 3) for e in longest}
    return found


# Stage 4: the environment of the paper


def paper(lab: Lab) -> Iterator[Check]:
    """The environment that the paper times."""
    yield "one robot of RUN at full size through Gymnasium", lambda: end_to_end(lab)


def end_to_end(lab: Lab) -> Figures:
    """Steps a second from a NumPy action to a NumPy observation, beside the paper's."""
    import gymnasium

    import dittogym  # noqa: F401  registers the environments

    options = {"particles": 60, "substeps": 3} if lab.tiny else {"particles": "full"}
    env = gymnasium.make("dittogym/run-coarse-v0", device=lab.device, **options)
    env.reset(seed=0)
    env.action_space.seed(0)
    rate = lab.rate(lambda: env.step(env.action_space.sample()), 1, 0.1 if lab.tiny else 5.0)
    return {"backend": backend_of(env.unwrapped.torch_env), "steps/s": rate, "× paper": rate / PAPER_SPEED}


# Stages 5 and 6: training


def training(lab: Lab) -> Iterator[Check]:
    """Short trainings by both learners, resumed and evaluated."""
    for learner in ("sac", "analytic"):
        yield learner, lambda learner=learner: train_briefly(lab, learner)
        yield f"{learner}, resumed", lambda learner=learner: train_briefly(lab, learner, resumed=True)
        yield f"{learner}, evaluated", lambda learner=learner: evaluate(lab, learner)


def train_options(lab: Lab, learner: str, steps: int) -> list[str]:
    """A training in one stage with one checkpoint; of SHAPE MATCH on the imitation, where its episodes are short."""
    task = "shapematch" if lab.tiny else "run"
    words = f"--task {task} --learner {learner} --steps {steps} --resolutions 4 --handover"
    words += f" --no-video --eval-every 0 --eval-episodes 1 --device {lab.device}"
    if not lab.tiny:
        robots = 1024 if learner == "sac" else 64
        words += f" --num-envs {robots} --log-every {8 * robots} --checkpoint-every {steps}"
        return words.split()
    words += " --particles 60 --substeps 2 --num-envs 2 --log-every 4 --random-steps 4 --batch-size 4 --update-start 4"
    if learner == "analytic":
        words = words.partition(" --random-steps")[0] + " --train-particles 60 --window 2 --minibatches 1"
        words += " --minibatch-size 4 --windows-kept 1 --warmup 0"
    return words.split()


def run_training(arguments: list[str]) -> None:
    """In this process, so that the imitation is used where there is no GPU."""
    from cfp import train

    try:
        code = train.main(arguments)
    except SystemExit as stopped:
        code = stopped.code
    if code not in (0, None, 128 + signal.SIGTERM):
        raise RuntimeError(f"cfp.train ended with {code}")


def train_briefly(lab: Lab, learner: str, resumed: bool = False) -> Figures:
    """Steps a second of a short training, the last losses, and the peak memory."""
    folder = lab.scratch / learner
    steps = (8 if lab.tiny else 65_536 if learner == "sac" else 8_192) * (2 if resumed else 1)
    if lab.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    start = time.perf_counter()
    run_training([*train_options(lab, learner, steps), "--out", str(folder), *["--resume"] * resumed])
    seconds = time.perf_counter() - start
    with (folder / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    losses = {name: float(text) for name, text in (rows or [{}])[-1].items() if "loss" in name and text}
    found: Figures = {"backend": trained_backend(folder), "steps/s": steps / (2 if resumed else 1) / seconds}
    if lab.device == "cuda":
        found["peak memory (GB)"] = torch.cuda.max_memory_allocated() / 1e9
    return found | losses | {"wrong": [f"{name} {value}" for name, value in losses.items() if not math.isfinite(value)]}


def trained_backend(folder: Path) -> str:
    """The backend of the physics that a run trains in."""
    import cfp
    from cfp.envs.make import make_torch_env

    env = make_torch_env(cfp.Run(folder).config.for_training(), 4, 1)
    env.reset(seed=0)
    return backend_of(env)


def evaluate(lab: Lab, learner: str) -> Figures:
    """Mean returns of the trained policy, and of zero and random actions."""
    from cfp import evaluate as program

    folder, printed = lab.scratch / learner, io.StringIO()
    words = [str(folder), "--episodes", "1" if lab.tiny else "16", "--device", lab.device, "--json"]
    with redirect_stdout(printed):
        code = program.main(words)
    if code:
        raise RuntimeError(f"cfp.evaluate ended with {code}")
    returns = {str(row["policy"]): row["mean"] for row in json.loads(printed.getvalue())}
    wrong = [f"{name} {value}" for name, value in returns.items() if not math.isfinite(value)]
    return {"backend": trained_backend(folder), **returns, "wrong": wrong}


def curve(lab: Lab) -> Iterator[Check]:
    """A learning curve of RUN from rewards, for as long as there is time."""
    yield "run from rewards", lambda: learn(lab)


def learn(lab: Lab) -> Figures:
    """Mean returns of the training's episodes over its steps and seconds."""
    folder, steps = lab.scratch / "curve", 8 if lab.tiny else 100_000_000
    timer = threading.Timer(max(lab.seconds - 25, 1), os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    start = time.perf_counter()
    try:
        # A stopped training saves its replay; all that a card can hold would take too long.
        replay = [] if lab.tiny else ["--buffer-size", "200000"]
        run_training([*train_options(lab, "sac", steps), *replay, "--out", str(folder)])
    finally:
        timer.cancel()
    seconds = time.perf_counter() - start
    with (folder / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    shown = rows[:: max(1, len(rows) // 20)]
    return {"backend": trained_backend(folder), "seconds": seconds, "rows": shown}


STAGES: dict[str, Callable[[Lab], Iterator[Check]]] = {
    "card": card,
    "tests": tests,
    "parity": parity,
    "speed": speed,
    "paper": paper,
    "training": training,
    "curve": curve,
}


# The process of a stage


def run_stage(lab: Lab, stage: str, first: int) -> int:
    """Run the checks of a stage from the given one on, and print a row for each; returns the exit code."""
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    for number, (name, check) in enumerate(STAGES[stage](lab)):
        if number < first:
            continue
        print(f"CHECK {number} {name}", flush=True)
        start, lost = time.perf_counter(), False
        try:
            figures = check()
        except Exception as error:  # whatever it is, the next check may still say something
            figures = {"wrong": [f"{type(error).__name__}: {error}"[:600]]}
            lost = "CUDA error" in str(error)
        wrong = figures.pop("wrong", [])
        if figures.get("backend") == "eager" and not name.endswith("eager"):
            wrong = [*wrong, "it ran on the eager backend"]
        row = {"stage": stage, "check": name, "backend": figures.pop("backend", None), "figures": figures}
        print("ROW " + json.dumps(row | {"wrong": wrong, "seconds": round(time.perf_counter() - start, 2)}), flush=True)
        if lost:
            return LOST
    return 0


# The program


class Report:
    """The results, written anew after each check."""

    def __init__(self, path: Path, device: str) -> None:
        self.path, self.device, self.rows = path, device, []
        path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, row: Figures) -> None:
        """Keep a row, and show it in one line."""
        self.rows.append(row)
        fresh = self.path.with_suffix(".part")
        fresh.write_text(
            json.dumps({"device": self.device, "date": f"{date.today()}", "rows": self.rows}, indent=1) + "\n"
        )
        os.replace(fresh, self.path)
        shown = ", ".join(f"{name} {short(value)}" for name, value in row["figures"].items())
        mark, what = ("FAILED", "; ".join(row["wrong"])) if row["wrong"] else ("ok", shown)
        print(" ".join(f"{row['stage']:9}{mark:7}{row['check']}: {what}"[:400].splitlines()), flush=True)


def short(value: Any) -> str:
    """A figure in a line."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)[:80]


def follow(command: list[str], stage: str, seconds: float, report: Report) -> int | None:
    """Run the process of a stage and report its rows; returns the check to go on with where the process broke off."""
    options: dict[str, Any] = {"text": True, "errors": "replace", "start_new_session": True}
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)
    lines: queue.Queue[str | None] = queue.Queue()

    def read() -> None:
        with child.stdout:
            for line in child.stdout:
                lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    end, said, number, running = time.monotonic() + seconds, [], -1, "its start"
    try:
        while (line := lines.get(timeout=max(0.01, end - time.monotonic()))) is not None:
            if line.startswith("ROW "):
                report.add(json.loads(line[4:]))
                running = ""
            elif line.startswith("CHECK "):
                number, running = int(line.split()[1]), line.split(maxsplit=2)[2].strip()
            else:
                said.append(line)
        code = child.wait()
    except queue.Empty:
        os.killpg(child.pid, signal.SIGKILL)  # and the processes that it started
        code = child.wait()
        said = ["out of time"]
    if code == 0:
        return None
    if running:
        why = f"the process ended with {code}: {''.join(said)[-800:]}"
        report.add({"stage": stage, "check": running, "backend": None, "figures": {}, "wrong": [why], "seconds": None})
    return number + 1 if number >= 0 else None


def run_all(args: argparse.Namespace, report: Report, scratch: Path) -> None:
    """All stages, one after the other, and the references beside them."""
    end, command = time.monotonic() + args.seconds, [sys.executable, __file__, "--device", args.device]
    command += ["--scratch", str(scratch)]
    with (scratch / "references.log").open("w") as log:
        references = subprocess.Popen([*command, "--stage", "references"], stdout=log, stderr=subprocess.STDOUT)
    try:
        for stage in args.stages:
            stage_end, first = min(end, time.monotonic() + LIMITS[stage] * args.seconds / 480), 0
            while first is not None and (left := stage_end - time.monotonic()) > 5:
                if references.poll():
                    (scratch / "no-references").touch()
                words = ["--stage", stage, "--first", str(first), "--seconds", f"{left:.0f}"]
                first = follow([*command, *words], stage, left, report)
    finally:
        references.kill()
        references.wait()


def summary(rows: list[Figures]) -> str:
    """A short table: speeds, and what failed."""
    lines = []
    for row in rows:
        figures = {
            name: value for name, value in row["figures"].items() if name.endswith("steps/s)") or name == "steps/s"
        }
        if figures:
            lines.append(
                f"{row['check']:48}{row['backend']}: {', '.join(f'{n} {short(v)}' for n, v in figures.items())}"
            )
    failed = [row for row in rows if row["wrong"]]
    lines += [f"{len(rows)} checks, {len(failed)} failed"]
    lines += [f"FAILED {row['stage']}: {row['check']}: {'; '.join(row['wrong'])}"[:300] for row in failed]
    return "\n".join(lines)


def default_path() -> Path:
    """Where the results go."""
    if not torch.cuda.is_available():
        return Path(tempfile.gettempdir()) / f"torchmpm-gpu-{os.getuid()}" / "imitation.json"
    name = re.sub(r"[^a-z0-9]+", "-", torch.cuda.get_device_name().lower()).strip("-")
    return RESULTS / f"{name}-{date.today()}.json"


def main() -> int:
    """Run everything, or one stage in this process; returns the exit code, 1 where a check failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--device", choices=("cuda", "imitation"), default="cuda" if torch.cuda.is_available() else None
    )
    parser.add_argument("--seconds", type=float, default=480.0, help="for everything (default 480)")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES), help="default: all")
    parser.add_argument("--out", type=Path, help="file of the results")
    parser.add_argument("--extra", action="store_true", help="print the extra of torchmpm that fits torch, and end")
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--scratch", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.extra:
        print(f"cuda{str(torch.version.cuda).partition('.')[0]}")
        return 0
    args.device = args.device or "imitation"
    sys.path[0] = str(ROOT)  # not this folder, in which `gpu` is this file
    if args.stage:
        tiny = args.device == "imitation"
        lab = Lab("cpu" if tiny else args.device, tiny, args.scratch, args.seconds)
        if args.stage == "references":
            write_references(lab)
            return 0
        with imitation() if tiny else nullcontext():
            return run_stage(lab, args.stage, args.first)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    report = Report(args.out or default_path(), args.device)
    print(f"{args.device}: results in {report.path}", flush=True)
    with tempfile.TemporaryDirectory(prefix="torchmpm-gpu-") as scratch:
        run_all(args, report, Path(scratch))
    print(summary(report.rows))
    return int(not report.rows or any(row["wrong"] for row in report.rows))


def imitation() -> Any:
    """Meanwhile, tensors on the CPU go to the CUDA kernels as the tests run them there."""
    sys.path += [str(ROOT / "tests"), str(ROOT / "tests/torchmpm")]
    from cuda_drivers import Imitation, in_use
    from short_episodes import short_episodes

    stack = ExitStack()
    stack.enter_context(in_use(Imitation()))
    stack.enter_context(short_episodes())
    return stack


if __name__ == "__main__":
    sys.exit(main())
