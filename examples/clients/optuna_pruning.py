"""Optuna over trainings: each evaluation is reported, and a training that falls behind the others ends early."""

import tempfile
from pathlib import Path

import optuna

import cfp

folder = tempfile.TemporaryDirectory()
quick = {"particles": 300, "substeps": 10, "num_envs": 2, "resolutions": (8,), "eval_episodes": 1, "video": False}
quick |= {"steps": 192, "eval_every": 64, "minibatches": 2}  # small, so that this takes seconds


def objective(trial):
    def report(row):
        trial.report(row["mean"], row["step"])
        if trial.should_prune():
            raise optuna.TrialPruned

    size = trial.suggest_float("action_step", 0.01, 1.0, log=True)
    own = Path(folder.name) / str(trial.number)
    run = cfp.fit("shapematch", action_step=(size,), out=own, quiet=True, on_evaluation=report, **quick)
    return run.results[-1]["mean"]  # of episodes that chose nothing


optuna.logging.set_verbosity(optuna.logging.WARNING)
pruner = optuna.pruners.MedianPruner(n_startup_trials=2)
study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=0), pruner=pruner)
study.optimize(objective, n_trials=6)
pruned = len(study.get_trials(states=(optuna.trial.TrialState.PRUNED,)))
print(f"{pruned} of 6 trainings pruned; best return {study.best_value:.0f} with {study.best_params}")
folder.cleanup()
