"""Actors and critics: what they compute, and the sizes of the reference's networks."""

from dataclasses import replace

import pytest
import torch
from torch import distributions

from cfp.agent.actor import ActorSpec, Encoded, Sample, build_actor, normalise_image
from cfp.envs.make import make_torch_env
from cfp.presets import sac_preset
from cfp.sac.policies import SmallCritics, TwinCritic
from dittogym import TASKS, make_spec


def images(count=3, seed=0):
    return torch.randint(0, 256, (count, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def widen(actor):
    """Give the heads outputs of some size, so that bounds and signs matter."""
    with torch.no_grad():
        for name in ("mean", "std", "gate"):
            if hasattr(actor, name):
                getattr(actor, name)[-1].weight.mul_(30)


def test_log_prob_is_that_of_a_squashed_gaussian():
    torch.manual_seed(0)
    actor = build_actor(ActorSpec((8,))).double()
    widen(actor)
    image = normalise_image(images()).double()
    torch.manual_seed(1)
    action, log_prob, gate, _ = actor.sample(image)
    torch.manual_seed(1)
    noise, latent = torch.randn_like(action), actor.encoder(image)
    std = torch.log1p(torch.exp(3 * actor.std(latent) - 1)).clamp(0.1, 6)
    assert (std == 0.1).any() and (std > 0.5).any()
    torch.testing.assert_close(action, torch.tanh(actor.mean(latent) + std * noise))
    # The 1e-6 in the reference's density is felt only where the action saturates.
    density = distributions.Normal(0.0, std).log_prob(std * noise) - torch.log(1 - action.square() + 1e-6)
    torch.testing.assert_close(log_prob, density.flatten(1).sum(1), rtol=1e-6, atol=1e-6)
    assert gate is None


@pytest.mark.parametrize("task", TASKS)
def test_closed_gates_leave_the_coarsest_field(task):
    config = sac_preset(task, "quick")
    config = replace(config, particles=100, substeps=1, num_envs=2)
    several = {config.resolutions, tuple(size for size in (4, 8, 16, 32, 64) if size <= make_spec(task).patch)}
    for resolutions in several:
        shut = replace(config, resolutions=resolutions, gate_bias=(-100.0,) * (len(resolutions) - 1))
        torch.manual_seed(0)
        finest, fields = build_actor(shut.actor_spec(len(resolutions))), []
        stages = [finest]
        while hasattr(stages[0], "coarse"):
            stages.insert(0, stages[0].coarse)
        action = 3 * torch.rand(2, 2, resolutions[0], resolutions[0]) - 1.5
        drawn = Sample(action, torch.zeros(2), None, (action,))
        stages[0].sample = lambda *_, drawn=drawn: drawn  # some of the field is clipped
        with torch.no_grad():
            for stage, actor in enumerate(stages, 1):
                env = make_torch_env(shut, shut.action_size(stage))
                observation, _ = env.reset(seed=0)
                env.step(actor(observation, deterministic=True))
                fields.append(env._actuation)
        share = (fields[0].abs() == fields[0].abs().max()).float().mean()
        assert 0 < share < 0.9
        for field in fields[1:]:
            torch.testing.assert_close(field, fields[0], rtol=0, atol=1e-5 * float(fields[0].abs().max()))


# Networks.


def trainable(module):
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


@pytest.mark.parametrize(
    ("resolutions", "split", "count"),
    [
        ((4,), False, 234176),
        ((8,), False, 80596),
        ((16,), False, 82388),
        ((32,), False, 82612),
        ((64,), False, 83388),
        ((8, 16), False, 96894),
        ((8, 16), True, 66174),
        ((32, 64), False, 98394),
        ((8,), True, 80596),  # the first stage never sees an action: split or not is the same
    ],
)
def test_actor_has_the_reference_size(resolutions, split, count):
    actor = build_actor(ActorSpec(resolutions, (-1.0,) * (len(resolutions) - 1), split=split))
    assert trainable(actor) == sum(parameter.numel() for parameter in actor.trainable_parameters()) == count


@pytest.mark.parametrize(("split", "count"), [(False, 526082), (True, 464642)])
def test_critics_have_the_reference_size_and_share_nothing(split, count):
    assert trainable(TwinCritic(8, split, "aligned")) == count


def test_small_critics_equal_each_on_its_own():
    critics, action = SmallCritics(8), torch.randn(2, 2, 8, 8)
    seen = Encoded(torch.randn(2, 3, 32, 32), torch.randn(2, 16, 4, 4))
    parts = critics.actions(action).chunk(2, dim=1)
    expected = [head(torch.cat([seen.features, part], 1)) for head, part in zip(critics.heads, parts, strict=True)]
    torch.testing.assert_close(list(critics(seen, action)), expected)


def test_linear_layers_are_xavier():
    torch.manual_seed(0)
    for layer in build_actor(ActorSpec((4,))).modules():
        if isinstance(layer, torch.nn.Linear):
            bound = (6 / (layer.in_features + layer.out_features)) ** 0.5
            assert 0.95 * bound < layer.weight.abs().max() <= bound and not layer.bias.any()
