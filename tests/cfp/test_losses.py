"""Networks evaluated together equal networks one by one; what bfloat16 may touch; life without a compiler."""

import pytest
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from test_algorithm import make_batch, make_model
from torch.nn import functional as F

from cfp.agent.actor import squashed_log_prob
from cfp.agent.losses import Losses, choose_precision
from cfp.agent.spec import ActorSpec

PLAIN = ActorSpec((32,))
LADDERS = {
    "plain": PLAIN,
    "linear heads": ActorSpec((4,)),
    "residual": ActorSpec((8, 16), (-1.0,)),
    "split": ActorSpec((32, 64), (0.0,), split=True, gate_scale=0.25),
}
CPU = torch.device("cpu")


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
    images = (image.double() / 127.5 - 1 for image in (batch.observations, batch.next_observations))
    now, later = images
    return ReplayBufferSamples(now, batch.actions.double(), later, batch.dones.double(), batch.rewards.double())


def after_updates(spec, double, **options):
    model = make_model(spec, gate_penalty=0.5, max_grad_norm=0.05, tau=0.1, alpha=0.02, **options)
    batch = make_batch(spec.resolutions[-1])
    if double:
        model.policy.double()
        model.reward_statistics.double()
        batch = in_double(batch)
    torch.manual_seed(0)
    scalars = [model.update(batch) for _ in range(4)]
    return model.policy.state_dict(), scalars


@pytest.mark.parametrize("spec", LADDERS.values(), ids=LADDERS)
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


def losses_and_gradients(spec, precision):
    model = make_model(spec, gate_penalty=0.5, precision=precision, max_grad_norm=1e9, learning_rate=0.0)
    torch.manual_seed(0)
    scalars = model.update(make_batch(spec.resolutions[-1], 16))
    actor, critic, _ = model.networks()
    gradients = {
        f"{owner}.{name}": parameter.grad
        for owner, network in (("actor", actor), ("critic", critic))
        for name, parameter in network.named_parameters()
        if parameter.grad is not None
    }
    return model, scalars, gradients


@pytest.mark.parametrize("spec", LADDERS.values(), ids=LADDERS)
def test_bfloat16_changes_losses_by_a_hundredth_and_gradients_by_a_twentieth(spec):
    _, exact, wanted = losses_and_gradients(spec, "float32")
    _, scalars, gradients = losses_and_gradients(spec, "bfloat16")
    assert any(not torch.equal(gradients[name], wanted[name]) for name in wanted)
    for name in ("critic_loss", "actor_loss", "q", "q_target"):
        assert scalars[name].item() == pytest.approx(exact[name].item(), rel=0.01, abs=0.01), name
    entries = 2 * spec.resolutions[-1] ** 2  # over which the entropy is a sum
    assert abs(scalars["entropy"] - exact["entropy"]) < 1e-3 * entries
    assert gradients.keys() == wanted.keys()
    for name, gradient in gradients.items():
        assert (gradient - wanted[name]).norm() < 0.05 * wanted[name].norm() + 1e-6, name


def test_bfloat16_leaves_everything_but_the_networks_in_float32(monkeypatch):
    densities = []

    def note(noise, std, action):
        densities.append((squashed_log_prob(noise, std, action), noise, std, action))
        return densities[-1][0]

    monkeypatch.setattr("cfp.agent.actor.squashed_log_prob", note)
    model, scalars, gradients = losses_and_gradients(LADDERS["residual"], "bfloat16")
    assert len(densities) == 4  # coarse and residual, for the target and for the actor
    for log_prob, *inputs in densities:
        assert all(value.dtype == torch.float32 for value in inputs)
        exact = squashed_log_prob(*(value.double() for value in inputs))
        torch.testing.assert_close(log_prob.double(), exact, rtol=1e-4, atol=1e-3)
    actor, critic, target = model.networks()
    states = [state for network in (actor, critic) for state in network.optimizer.state.values()]
    kept = [value for state in states for value in state.values()] + list(model.reward_statistics.buffers())
    kept += [*gradients.values(), *scalars.values(), *model.policy.parameters(), *target.parameters()]
    assert {value.dtype for value in kept} == {torch.float32}


def test_acting_is_in_float32():
    image = make_batch(32).observations.numpy()
    actions = [make_model(PLAIN, precision=name).predict(image, deterministic=True)[0] for name in ("float32", "auto")]
    assert (actions[0] == actions[1]).all()


@pytest.mark.parametrize("found", [None, "avx512_bf16", "amx_bf16"])
def test_bfloat16_is_chosen_where_the_processor_multiplies_it(monkeypatch, found):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {found: True, "avx2": True}, raising=False)
    assert choose_precision("auto", CPU) == ("float32" if found is None else "bfloat16")
    assert choose_precision("auto", torch.device("cuda")) == "float32"
    assert choose_precision("bfloat16", CPU) == "bfloat16"


def test_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="precision must be 'auto', 'float32' or 'bfloat16', got 'half'"):
        make_model(PLAIN, precision="half")


def test_update_without_a_compiler_says_so_and_runs(monkeypatch, caplog):
    monkeypatch.setattr("cfp.agent.losses.compiler_found", lambda: False)
    model = make_model(PLAIN, compile=True)
    assert "not compiled, only slower: no C++ compiler" in caplog.text
    assert model.update(make_batch(32))["critic_loss"].isfinite()


def test_failed_compilation_says_so_once_and_goes_on(monkeypatch, caplog):
    def refuse(function, **_):
        def run(*arguments):
            raise torch._dynamo.exc.InternalTorchDynamoError("disk full\nand more")

        return run

    monkeypatch.setattr("cfp.agent.losses.compiler_found", lambda: True)
    monkeypatch.setattr(torch, "compile", refuse)
    losses = Losses(CPU, "float32", compile=True)
    model = make_model(PLAIN)
    _, critic, _ = model.networks()
    batch = make_batch(32)
    wanted = torch.ones(len(batch.actions), 1)
    values = [losses.critic_loss(critic, batch.observations, batch.actions, wanted).item() for _ in range(2)]
    expected = sum(F.mse_loss(value, wanted) for value in critic(batch.observations, batch.actions))
    assert values[0] == values[1] == pytest.approx(expected.item())
    assert [record.getMessage() for record in caplog.records] == [
        "updates are not compiled, only slower: torch.compile failed (disk full)"
    ]


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_compiled_update_equals_the_plain_one(precision):
    spec = LADDERS["residual"]
    plain, wanted = after_updates(spec, False, precision=precision)
    fast, scalars = after_updates(spec, False, precision=precision, compile=True)
    rel = 1e-4 if precision == "float32" else 0.02
    for name, value in scalars[0].items():
        assert value.item() == pytest.approx(wanted[0][name].item(), rel=rel, abs=rel), name
    for name, value in fast.items():
        assert (value - plain[name]).abs().mean() < 1.2e-3 * (0.05 if precision == "float32" else 1.0), name


@pytest.mark.parametrize("name", ["plain", "residual"])
def test_anchor_costs_the_square_of_the_way_from_the_origin(name):
    model, other = (make_model(LADDERS[name]) for _ in range(2))
    (actor, critic, _), origin = model.networks(), other.networks()[0]
    now = model.losses.prepare(make_batch(8).observations)
    losses = []
    for arguments in ((), (origin, 3.0)):
        torch.manual_seed(5)
        losses.append(model.losses.actor_loss(actor, critic, now, torch.tensor(0.1), 0.2, *arguments))
    torch.manual_seed(5)
    drift = (actor(now) - origin(now, deterministic=True)).square().mean()
    assert losses[1][1]["drift"].item() == pytest.approx(drift.item(), rel=1e-5)
    assert (losses[1][0] - losses[0][0]).item() == pytest.approx(3 * drift.item(), rel=1e-4)
