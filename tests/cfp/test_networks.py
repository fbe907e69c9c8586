import pytest
import torch
from torch.nn import functional as F

from cfp.agent.actor import (
    ActorSpec,
    Encoded,
    Encoder,
    PairEncoder,
    build_actor,
    decode,
    make_head,
    upsample,
)
from cfp.sac.policies import SmallCritics, TwinCritic


def trainable(module):
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


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


@pytest.mark.parametrize("interpolation", ["half_pixel", "aligned"])
@pytest.mark.parametrize(("before", "after"), [(8, 16), (8, 64), (64, 64)])
def test_upsampling_is_bicubic(before, after, interpolation):
    action = torch.randn(2, 2, before, before, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = F.interpolate(action, size=(after, after), mode="bicubic", align_corners=interpolation == "aligned")
    torch.testing.assert_close(upsample(action, after, interpolation), expected, rtol=0, atol=1e-12)


def plainly(encoder, image):
    """`Encoder` through PyTorch's layers, with the coordinates stacked to the image."""
    line = (torch.arange(64) - 32) / 32
    grid = torch.stack(torch.meshgrid(line, line, indexing="ij")).to(image)
    return encoder.rest(encoder.first(torch.cat([image, grid.expand(len(image), -1, -1, -1)], dim=1)))


def pair_plainly(pair, image, patch):
    if len(pair.encoders) == 1:
        return plainly(pair.encoders[0], torch.cat([image, patch], dim=1))
    return torch.cat([plainly(pair.encoders[0], image), plainly(pair.encoders[1], patch)], dim=1)


def assert_same_values_and_gradients(module, inputs, fast, plain):
    gradients = []
    for outputs in (fast, plain):
        values = torch.cat([value.flatten() for value in outputs])
        gradients.append(torch.autograd.grad(values.square().sum(), [*inputs, *module.parameters()], allow_unused=True))
    torch.testing.assert_close(*(torch.cat([value.flatten() for value in each]) for each in (fast, plain)))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


def leaf(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).requires_grad_()


@pytest.mark.parametrize("split", [False, True])
def test_encoders_are_convolutions_of_images_and_coordinates(split):
    image, patch = leaf(2, 3, 64, 64), leaf(2, 2, 64, 64, seed=1)
    encoder = Encoder(3, 8).double()
    assert_same_values_and_gradients(encoder, [image], [encoder(image)], [plainly(encoder, image)])
    pair = PairEncoder(split).double()
    assert_same_values_and_gradients(pair, [image, patch], [pair(image, patch)], [pair_plainly(pair, image, patch)])


@pytest.mark.parametrize("resolution", [4, 8, 32])
def test_joined_heads_equal_each_on_its_own(resolution):
    heads, latent = torch.nn.ModuleList(make_head(resolution) for _ in range(3)).double(), leaf(2, 32, 4, 4)
    assert_same_values_and_gradients(heads, [latent], decode(list(heads), latent), [head(latent) for head in heads])


@pytest.mark.parametrize("split", [False, True])
def test_twin_critics_equal_each_on_its_own(split):
    twin, image, action = TwinCritic(8, split, "half_pixel").double(), leaf(2, 3, 64, 64), leaf(2, 2, 8, 8, seed=1)
    patch = upsample(action, 64, "half_pixel")
    plain = [each.value(pair_plainly(each.encoder, image, patch)) for each in twin.critics]
    assert_same_values_and_gradients(twin, [image, action], twin(image, action), plain)


def test_small_critics_equal_each_on_its_own():
    actor, critics = build_actor(ActorSpec((8,), encoder="small")).double(), SmallCritics(8).double()
    image, action = leaf(2, 3, 32, 32), leaf(2, 2, 8, 8)
    seen = Encoded(image, actor.encoder(image))
    parts = critics.actions(action).chunk(2, dim=1)
    plain = [head(torch.cat([seen.features, part], 1)) for head, part in zip(critics.heads, parts, strict=True)]
    assert_same_values_and_gradients(critics, [action], critics(seen, action), plain)


def test_linear_layers_are_xavier():
    torch.manual_seed(0)
    for layer in build_actor(ActorSpec((4,))).modules():
        if isinstance(layer, torch.nn.Linear):
            bound = (6 / (layer.in_features + layer.out_features)) ** 0.5
            assert 0.95 * bound < layer.weight.abs().max() <= bound and not layer.bias.any()
