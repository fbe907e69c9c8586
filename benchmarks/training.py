"""Cost of a training step and its parts: `python benchmarks/training.py`.

Prints for each update the seconds, floating-point operations and the share of the speed of a matrix product, training
steps per second of the preset quick and of its former options with the shares of simulation, updates and the rest, and
environment steps per second alone.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from unittest import mock

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.utils.flop_counter import FlopCounterMode

import dittogym  # noqa: F401  (registers the environments)
from cfp import CFP, CFPPolicy, SACConfig
from cfp.envs.make import make_env
from cfp.experiment.cli import keep_memory
from cfp.presets import sac_preset


def make_model(config: SACConfig, stage: int, num_envs: int) -> CFP:
    """The model of one stage of a configuration, with updates of all networks from the first steps on."""
    hyperparameters = replace(
        config.hyperparameters(stage),
        buffer_size=2_000,
        update_start=config.batch_size,
        random_steps=0,
        actor_start=0,
    )
    model = CFP(
        CFPPolicy,
        make_env(config, config.action_size(stage), num_envs),
        hyperparameters,
        policy_kwargs={"spec": config.actor_spec(stage)},
        seed=0,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    return model


def make_batch(size: int, resolution: int) -> ReplayBufferSamples:
    """Random transitions."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (2, size, 3, 64, 64), dtype=torch.uint8, generator=generator)
    actions = torch.rand(size, 2, resolution, resolution, generator=generator) * 2 - 1
    rewards, dones = torch.randn(2, size, 1, generator=generator)
    return ReplayBufferSamples(images[0], actions, images[1], (dones > 2).float(), rewards)


def minimum_seconds(function: Callable[[], object], repeats: int) -> float:
    """Minimum seconds of a call: of the processor with one thread, so that other programs count less."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    seconds = []
    for _ in range(repeats + 2):  # two calls for warming up
        start = clock()
        function()
        seconds.append(clock() - start)
    return min(seconds[2:])


def count_flop(model: CFP, batch: ReplayBufferSamples) -> int:
    """Floating-point operations of an update: convolutions and matrix products of every head on its own."""
    plain = mock.patch("cfp.agent.actor.decode", lambda heads, latent: [head(latent) for head in heads])
    with plain, FlopCounterMode(display=False) as counter:
        model.update(batch)
    return counter.get_total_flops()


def updates(config: SACConfig, repeats: int) -> None:
    """Print the cost of an update next to that of a matrix product."""
    matrix = torch.randn(1024, 1024)
    peak = 2 * 1024**3 / minimum_seconds(lambda: matrix @ matrix, repeats)
    print(f"matrix product: {peak / 1e9:.0f} GFLOP/s")
    print("| stage | batch | GFLOP | seconds | GFLOP/s | share of the matrix product |")
    print("| --- " * 6 + "|")
    for stage in (1, 2):
        model = make_model(config, stage, 1)
        for size in (64, 256):
            batch = make_batch(size, config.action_size(stage))
            flop = count_flop(model, batch)
            seconds = minimum_seconds(partial(model.update, batch), repeats)
            speed = flop / seconds
            cells = f"{flop / 1e9:.1f} | {seconds:.4f} | {speed / 1e9:.0f} | {100 * speed / peak:.0f} %"
            print(f"| {stage} | {size} | {cells} |", flush=True)


@contextmanager
def timed(owner: object, name: str, clock: dict[str, float]) -> Iterator[None]:
    """Add up the seconds spent in a method."""
    method = getattr(owner, name)

    def run(*arguments: object, **options: object) -> object:
        start = time.perf_counter()
        try:
            return method(*arguments, **options)
        finally:
            clock[name] = clock.get(name, 0.0) + time.perf_counter() - start

    setattr(owner, name, run)
    try:
        yield
    finally:
        delattr(owner, name)


def former_quick(task: str) -> SACConfig:
    """Options of the preset quick before its networks became small."""
    plain = {"final_rate": 1.0, "n_steps": 1, "weight_average": 0.0, "noise_cells": 0}
    learning = {"batch_size": 64, "learning_rate": 1e-3, "gamma": 0.9, "tau": 0.01, "gradient_steps": 4}
    resolutions = sac_preset(task, "paper").resolutions
    return replace(sac_preset(task, "quick"), resolutions=resolutions, encoder="paper", **plain, **learning)


def training(task: str, steps: int) -> None:
    """Print training steps per second and the shares of their parts."""
    print(f"| {task}, preset | stage | training steps/s | simulation | updates | rest |")
    print("| --- " * 6 + "|")
    for name, config in (("former quick", former_quick(task)), ("quick", sac_preset(task, "quick"))):
        num_envs = config.num_envs
        for stage in (1, 2):
            model = make_model(config, stage, num_envs)
            clock: dict[str, float] = {}
            model.learn(config.batch_size + 2 * num_envs)
            with timed(model.env, "step", clock), timed(model, "train", clock):
                start = time.perf_counter()
                model.learn(steps * num_envs, reset_num_timesteps=False)
                total = time.perf_counter() - start
            simulation, update = clock["step"] / total, clock["train"] / total
            shares = " | ".join(f"{100 * share:.0f} %" for share in (simulation, update, 1 - simulation - update))
            print(f"| {name} | {stage} | {steps * num_envs / total:.1f} | {shares} |", flush=True)


def environments(steps: int) -> None:
    """Print environment steps per second of RUN under Gymnasium's vector interface."""
    for count in (16, 64):
        env = gymnasium.make_vec(
            "dittogym/run-coarse-v0", num_envs=count, vectorization_mode="vector_entry_point", particles="lite"
        )
        env.reset(seed=0)
        action = np.asarray(env.action_space.sample())
        seconds = minimum_seconds(partial(env.step, action), steps)
        print(f"make_vec, {count} x lite RUN: {count / seconds:.0f} environment steps/s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=12, help="repeats of an update")
    parser.add_argument("--steps", type=int, default=12, help="batched training steps, and environment steps")
    parser.add_argument("--skip", nargs="*", default=[], choices=("updates", "training", "environments"))
    arguments = parser.parse_args()
    keep_memory()
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
    if "updates" not in arguments.skip:
        for task in ("run", "shapematch"):
            print(f"{task}, preset paper")
            updates(sac_preset(task, "paper"), arguments.rounds)
    if "training" not in arguments.skip:
        for task in ("run", "shapematch"):
            training(task, arguments.steps)
    if "environments" not in arguments.skip:
        environments(arguments.steps)


if __name__ == "__main__":
    main()
