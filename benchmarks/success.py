"""Success rate of a policy within the first steps of an episode, under Gaussian noise on its actions.

Run ``python benchmarks/success.py POLICY``. ``python -m baselines.robustness --cases noise`` measures whole episodes;
this is faster where a policy succeeds early or never, as the recorded plan of GROW does.
"""

import argparse
from dataclasses import replace

import baselines.registry  # noqa: F401  (adds the algorithms)
from baselines.compare.stats import wilson_interval
from cfp.envs.disturbances import Case, Disturbed
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import monitored
from cfp.evaluate import open_policy
from cfp.evaluation.episodes import Trial
from cfp.evaluation.returns import decision_grid, evaluate, evaluation_seed

#: Episodes between two reports.
BATCH = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="a policy file, or the name of one that comes with the package")
    parser.add_argument("--steps", type=int, default=45, help="control steps after which an episode is truncated")
    parser.add_argument("--noise", type=float, default=0.1, help="standard deviation on every action entry")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--particles", choices=("full", "lite"), default="full")
    arguments = parser.parse_args()
    config, policies = open_policy(arguments.policy, "cpu", None)
    config = replace(config, particles=arguments.particles)
    policy = policies.popitem()[1]
    case = Case("noise", action_noise=arguments.noise)

    def make_env(seed: int, count: int) -> Disturbed:
        env = monitored(make_torch_env(config, policy.resolution, count), arguments.steps)
        return Disturbed(env, case, seed, decision_grid(policy))

    successes = done = 0
    while done < arguments.episodes:
        count = min(BATCH, arguments.episodes - done)
        trial = Trial(
            name="",
            resolution=policy.resolution,
            policy=policy,
            make_env=make_env,
            episodes=count,
            deterministic=policy.deterministic_by_default,
            seed=evaluation_seed(config) + done,
        )
        result = evaluate([trial])[0]
        if result.success is None:
            parser.error(f"policy must be for a task that defines success, got one for {config.task}")
        done, successes = done + count, successes + round(result.success * count)
        low, high = wilson_interval(successes, done)
        print(f"{successes} of {done} episodes, 95 % interval {low:.0%} to {high:.0%}", flush=True)


if __name__ == "__main__":
    main()
