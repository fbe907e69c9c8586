"""Networks that are evaluated together equal networks evaluated one by one; the anchor of a refined policy."""

import pytest
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from test_algorithm import make_batch, make_model

from cfp.agent.losses import actor_loss
from cfp.agent.networks import normalise_image
from cfp.agent.spec import ActorSpec

SPECS = {
    "plain": ActorSpec((32,)),
    "linear heads": ActorSpec((4,)),
    "residual": ActorSpec((8, 16), (-1.0,)),
    "split": ActorSpec((32, 64), (0.0,), split=True, gate_scale=0.25),
}


def encode_one_by_one(encoders, *images):
    line = (torch.arange(64) - 32) / 32
    grid = torch.stack(torch.meshgrid(line, line, indexing="ij")).to(images[0])
    image = torch.cat([*images, grid.expand(len(images[0]), -1, -1, -1)], dim=1)
    return torch.cat([encoder.rest(encoder.first(image)) for encoder in encoders], dim=1)


def one_by_one(patch):
    """Let every network compute on its own, through PyTorch's layers."""
    patch.setattr("cfp.agent.fused.encode", encode_one_by_one)
    patch.setattr("cfp.agent.fused.decode", lambda heads, latent: [head(latent) for head in heads])
    patch.setattr(
        "cfp.agent.fused.multilayer_perceptrons",
        lambda each, values: torch.stack([one(x) for one, x in zip(each, values, strict=True)]),
    )


def in_double(batch):
    obs, next_obs = (image.double() / 127.5 - 1 for image in (batch.observations, batch.next_observations))
    return ReplayBufferSamples(obs, batch.actions.double(), next_obs, batch.dones.double(), batch.rewards.double())


def after_updates(spec, double):
    model = make_model(spec, gate_penalty=0.5, max_grad_norm=0.05, tau=0.1, alpha=0.02)
    batch = make_batch(spec.resolutions[-1])
    if double:
        model.policy.double()
        model.reward_statistics.double()
        batch = in_double(batch)
    torch.manual_seed(0)
    scalars = [model.update(batch) for _ in range(2)]  # the second with a momentum
    return model.policy.state_dict(), scalars


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@pytest.mark.parametrize("double", [True, False], ids=["float64", "float32"])
def test_updates_of_joined_networks_equal_those_one_by_one(spec, double):
    weights, scalars = after_updates(spec, double)
    with pytest.MonkeyPatch.context() as patch:
        one_by_one(patch)
        expected, wanted = after_updates(spec, double)
    # Adam divides by the size of the gradient, so that one near zero may differ by a whole step of 3e-4 in float32.
    close = {"rtol": 1e-10, "atol": 1e-10} if double else {"rtol": 1e-3, "atol": 3e-4}
    assert weights.keys() == expected.keys()
    for name, value in weights.items():
        torch.testing.assert_close(value, expected[name], **close)
        assert (value - expected[name]).abs().mean() < (1e-11 if double else 1e-6), name
    for got, want in zip(scalars, wanted, strict=True):
        assert got.keys() == want.keys()
        for name, value in got.items():
            close = {"rtol": 1e-10, "atol": 1e-10} if double else {"rtol": 1e-4, "atol": 1e-5}
            torch.testing.assert_close(value, want[name], **close)


@pytest.mark.parametrize("name", ["plain", "residual"])
def test_anchor_costs_the_square_of_the_way_from_the_origin(name):
    model, other = (make_model(SPECS[name]) for _ in range(2))
    (actor, critic, _), origin = model.networks(), other.networks()[0]
    obs = normalise_image(make_batch(8).observations)
    losses = []
    for arguments in ((), (origin, 3.0)):
        torch.manual_seed(5)
        losses.append(actor_loss(actor, critic, obs, torch.tensor(0.1), 0.2, *arguments))
    torch.manual_seed(5)
    drift = (actor(obs) - origin(obs, deterministic=True)).square().mean()
    assert losses[1][1]["drift"].item() == pytest.approx(drift.item(), rel=1e-5)
    assert (losses[1][0] - losses[0][0]).item() == pytest.approx(3 * drift.item(), rel=1e-4)
