"""Policy files as a training of the coarse-to-fine policy writes them."""

from dataclasses import asdict

from cfp.policy import KIND, describe_run, write_policy


def describe_actor(config, stage, steps):
    return describe_run(config, KIND, stage, steps) | {"network": asdict(config.actor_spec(stage))}


def save_actor(path, actor, config, stage, steps):
    write_policy(path, actor.state_dict(), describe_actor(config, stage, steps))
