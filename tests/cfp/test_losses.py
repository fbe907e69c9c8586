"""The anchor of a refined policy."""

import pytest
import torch
from test_algorithm import make_batch, make_model

from cfp.agent.actor import ActorSpec, normalise_image
from cfp.agent.losses import actor_loss

SPECS = {
    "plain": ActorSpec((32,)),
    "residual": ActorSpec((8, 16), (-1.0,)),
}


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
