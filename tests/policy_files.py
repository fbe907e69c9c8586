"""Policy files as a training of the coarse-to-fine policy writes them, and as anybody may."""

import json
from dataclasses import asdict

import safetensors.torch

from cfp.policy import FORMAT, KIND, describe_run, write_policy


def describe_actor(config, stage, steps):
    return describe_run(config, KIND, stage, steps) | {"network": asdict(config.actor_spec(stage))}


def save_actor(path, actor, config, stage, steps):
    write_policy(path, actor.state_dict(), describe_actor(config, stage, steps))


def write_stranger(path, tensors, description):
    """Any weights with any description, in the format of policies."""
    safetensors.torch.save_file(tensors, path, {FORMAT: json.dumps(description)})
