"""An Optuna study: the frequency and wave number of a contraction wave with which the robot of RUN comes furthest."""

import math

import optuna
import torch

import dittogym

env = dittogym.TorchEnv("run", particles=500)  # few, so that this takes seconds
columns = torch.arange(env.action_shape[-1]) / env.action_shape[-1]


@torch.no_grad()
def displacement(trial):
    frequency = trial.suggest_float("frequency", 0.02, 0.5)
    waves = trial.suggest_float("waves", -2.0, 2.0)
    env.reset(seed=0)
    for step in range(20):
        wave = torch.sin(2 * math.pi * (waves * columns + frequency * step))
        info = env.step(wave.expand(1, *env.action_shape))[-1]
    return info["displacement"].item()


optuna.logging.set_verbosity(optuna.logging.WARNING)
study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=0))
study.optimize(displacement, n_trials=8)
print(f"{study.best_value:.4f} m with {study.best_params}")
