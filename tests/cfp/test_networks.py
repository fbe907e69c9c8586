import pytest
import torch
from torch import nn
from torch.nn import functional as F

from cfp.agent.actor import Actor, build_actor
from cfp.agent.networks import Encoder, TwinCritic, make_head, upsample
from cfp.agent.spec import ActorSpec


def trainable(module):
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


@pytest.mark.parametrize(
    ("channels", "width", "count"), [(3, 32, 61568), (5, 32, 65664), (3, 16, 17984), (2, 16, 16960)]
)
def test_encoder_has_the_reference_size(channels, width, count):
    assert trainable(Encoder(channels, width)) == count


@pytest.mark.parametrize(("resolution", "count"), [(4, 86304), (8, 9514), (16, 10410), (32, 10522), (64, 10910)])
def test_head_has_the_reference_size_and_shape(resolution, count):
    head = make_head(resolution)
    assert trainable(head) == count
    assert head(torch.zeros(2, 32, 4, 4)).shape == (2, 2, resolution, resolution)


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
        ((16, 32), False, 97230),
        ((32, 64), False, 98394),
        ((8,), True, 80596),  # the first stage never sees an action: split or not is the same
    ],
)
def test_actor_has_the_reference_size(resolutions, split, count):
    actor = build_actor(ActorSpec(resolutions, (-1.0,) * (len(resolutions) - 1), split=split))
    assert trainable(actor) == count
    assert sum(parameter.numel() for parameter in actor.trainable_parameters()) == count


@pytest.mark.parametrize(("split", "count"), [(False, 526082), (True, 464642)])
def test_critics_have_the_reference_size(split, count):
    critic = TwinCritic(8, split, "aligned")
    assert trainable(critic) == count
    first, second = critic.critics
    assert not {id(parameter) for parameter in first.parameters()} & {
        id(parameter) for parameter in second.parameters()
    }


@pytest.mark.parametrize("interpolation", ["half_pixel", "aligned"])
@pytest.mark.parametrize(("before", "after"), [(8, 16), (8, 64), (32, 64), (64, 64)])
def test_upsampling_is_bicubic(before, after, interpolation):
    action = torch.randn(2, 2, before, before, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = F.interpolate(action, size=(after, after), mode="bicubic", align_corners=interpolation == "aligned")
    torch.testing.assert_close(upsample(action, after, interpolation), expected, rtol=0, atol=1e-12)


def test_linear_layers_are_xavier():
    torch.manual_seed(0)
    actor = Actor(4, ActorSpec((4,)))
    for layer in actor.modules():
        if isinstance(layer, nn.Linear):
            bound = (6 / (layer.in_features + layer.out_features)) ** 0.5
            assert layer.weight.abs().max() <= bound
            assert layer.weight.abs().max() > 0.95 * bound
            assert not layer.bias.any()
