"""Gymnasium's AsyncVectorEnv, a process for each environment, with each way of starting processes."""

import gymnasium
import numpy as np

import dittogym


def make():
    return dittogym.Env("run", particles=500, substeps=10)  # small, so that this takes seconds


def main():
    for context in ("fork", "forkserver", "spawn"):
        envs = gymnasium.vector.AsyncVectorEnv([make, make], context=context)
        envs.reset(seed=0)
        rewards = [envs.step(np.zeros(envs.action_space.shape, np.float32))[1] for _ in range(3)]
        envs.close()
        print(f"{context}: rewards {np.sum(rewards, axis=0).round(2)}")


if __name__ == "__main__":  # the processes of forkserver and spawn import this file
    main()
