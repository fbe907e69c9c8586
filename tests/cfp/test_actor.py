from dataclasses import replace

import pytest
import torch
from torch import distributions
from torch.nn import functional as F

from cfp.agent.actor import ActorSpec, Sample, build_actor, normalise_image, upsample
from cfp.envs.make import make_torch_env
from cfp.presets import sac_preset
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


@pytest.mark.parametrize(("split", "scale"), [(False, 1.0), (True, 0.25)])
@pytest.mark.parametrize("interpolation", ["half_pixel", "aligned"])
def test_gate_blends_residual_and_coarse(split, scale, interpolation):
    torch.manual_seed(0)
    actor = build_actor(ActorSpec((8, 16), (-0.5,), split, scale, interpolation))
    widen(actor)
    image = images()
    action, _, gate, _ = actor.sample(image, deterministic=True)
    coarse = actor.coarse(image, deterministic=True)
    lifted = F.interpolate(coarse, size=(16, 16), mode="bicubic", align_corners=interpolation == "aligned")
    patch = F.interpolate(lifted, size=(64, 64), mode="bicubic", align_corners=interpolation == "aligned")
    latent = actor.encoder(normalise_image(image), patch)
    expected_gate = scale / (1 + torch.exp(-(actor.gate(latent) - 0.5)))
    expected = expected_gate * torch.tanh(actor.mean(latent)) + (1 - expected_gate) * lifted
    torch.testing.assert_close(gate, expected_gate, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(action, expected, rtol=1e-4, atol=1e-5)
    assert gate.shape == (3, 2, 16, 16)
    assert gate.max() <= scale


@pytest.mark.parametrize("resolutions", [(8, 16), (32, 64), (4, 8, 16, 32, 64)])
def test_closed_gates_leave_the_coarsest_action(resolutions):
    torch.manual_seed(0)
    actor = build_actor(ActorSpec(resolutions, (-100.0,) * (len(resolutions) - 1)))
    image = images()
    coarsest = actor
    while hasattr(coarsest, "coarse"):
        coarsest = coarsest.coarse
    expected = coarsest(image, deterministic=True)
    for resolution in resolutions[1:]:
        expected = upsample(expected, resolution, "half_pixel")
    torch.testing.assert_close(actor(image, deterministic=True), expected, rtol=0, atol=1e-6)


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


def test_composed_action_is_not_clipped():
    torch.manual_seed(0)
    actor = build_actor(ActorSpec((8, 16), (-100.0,)))
    with torch.no_grad():
        actor.coarse.mean[-1].weight.mul_(1000)
    assert actor(images(), deterministic=True).abs().max() > 1.001


def test_coarser_stages_are_frozen_and_drawn_anew():
    torch.manual_seed(0)
    actor = build_actor(ActorSpec((8, 16), (0.0,)))
    image = images()
    action, log_prob, gate, _ = actor.sample(image)
    (action.square().sum() + log_prob.sum()).backward()
    assert all(parameter.grad is None for parameter in actor.coarse.parameters())
    assert all(parameter.grad is not None for parameter in actor.trainable_parameters())
    assert gate.requires_grad
    state = torch.get_rng_state()
    first = actor.coarse(image)
    torch.set_rng_state(state)
    torch.testing.assert_close(actor.coarse(image), first)
    assert not torch.equal(actor.coarse(image), first)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"resolutions": (7,)}, "resolutions must be increasing"),
        ({"resolutions": (16, 8)}, "resolutions must be increasing"),
        ({"resolutions": ()}, "resolutions must be increasing"),
        ({"gate_bias": ()}, "gate_bias must have 1 values"),
        ({"encoder": "large"}, "encoder must be paper or small, got 'large'"),
        ({"interpolation": "bilinear"}, "interpolation must be half_pixel or aligned, got 'bilinear'"),
        ({"gate_scale": -0.25}, "gate_scale must be positive, got -0.25"),
        ({"gate_scale": float("nan")}, "gate_scale must be positive, got nan"),
    ],
)
def test_impossible_structures_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        ActorSpec(**{"resolutions": (8, 16), "gate_bias": (0.0,)} | fields)
