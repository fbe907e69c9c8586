"""Modular policies: their networks, their updates, and the policy on its own."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples

import baselines
from baselines.modular.env import SegmentedEnv
from baselines.modular.kmeans import fit, update
from baselines.modular.networks import ModularActor, ModularCritics, SegmentPolicy
from baselines.modular.nodes import Nodes, pack, visible_positions
from baselines.modular.train import Modular, ModularConfig
from baselines.registry import configure, find
from cfp.envs.disturbances import Case
from cfp.envs.vec_env import TorchVecEnv
from cfp.errors import CheckpointError, ConfigError
from cfp.policy import describe_run
from cfp.robustness import report
from cfp.sections import EnvironmentConfig, ReportConfig
from dittogym import TorchEnv
from dittogym.action import from_grid_layout, to_grid_layout

KINDS = ("gnn", "transformer")
FEATURES = 10


def rows(batch, count, kind):
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(batch, count, FEATURES, generator=generator)
    if kind != "gnn":
        return features, None
    edges = torch.rand(batch, count, count, generator=generator) < 0.3
    edges = edges | edges.transpose(1, 2)
    return torch.cat((features, pack(edges)), -1), (features, edges)


def permuted(kind, data, parts, order):
    if kind != "gnn":
        return data[:, order]
    features, edges = parts
    return torch.cat((features[:, order], pack(edges[:, order][:, :, order])), -1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [16, 64])
def test_permutation_of_segments_permutes_the_actions(kind, count):
    torch.manual_seed(0)
    actor, critics = ModularActor(kind, FEATURES), ModularCritics(kind, FEATURES)
    data, parts = rows(3, count, kind)
    order = torch.randperm(count)
    other = permuted(kind, data, parts, order)
    actions = actor(data, True)
    assert actions.shape == (3, count, 2) and actions.std() > 1e-3
    assert torch.allclose(actor(other, True), actions[:, order], atol=1e-5)
    for value, same in zip(critics(data, actions), critics(other, actions[:, order].flatten(1)), strict=True):
        assert value.shape == (3, 1) and torch.allclose(value, same, atol=1e-5)


def test_messages_go_along_edges_only():
    torch.manual_seed(0)
    actor = ModularActor("gnn", FEATURES)
    features = torch.randn(1, 6, FEATURES)
    edges = torch.zeros(1, 6, 6, dtype=torch.bool)
    for i in range(5):  # a chain; three rounds reach three nodes far
        edges[0, i, i + 1] = edges[0, i + 1, i] = True
    changed = features.clone()
    changed[0, 0] += 1.0
    before, after = (actor(torch.cat((each, pack(edges)), -1), True)[0] for each in (features, changed))
    moved = (before - after).abs().amax(-1) > 1e-7
    assert moved.tolist() == [True, True, True, True, False, False]


@pytest.mark.parametrize(("kind", "actor", "critics"), [("gnn", 67_972, 300_546), ("transformer", 416_132, 996_866)])
def test_networks_have_the_documented_sizes(kind, actor, critics):
    """For 10 features; the same for 16 and 64 segments, whose weights are shared. The paper gives no sizes."""
    found = [sum(p.numel() for p in network(kind, FEATURES).parameters()) for network in (ModularActor, ModularCritics)]
    assert found == [actor, critics]


def config(algo, **changes):
    base = configure({"algo": algo, "task": "run"})
    return replace(
        base,
        device="cpu",
        steps=40,
        random_steps=10,
        environment=EnvironmentConfig(num_envs=2, particles=200, substeps=2),
        report=ReportConfig(eval_every=0, eval_episodes=1, video=False, checkpoint_every=20, log_every=20),
        learning=replace(base.learning, batch_size=8, buffer_size=60, update_start=8),
        **changes,
    )


def model_of(algo, folder):
    return find(algo).create(config(algo), 1, folder).model


def test_options_common_to_a_comparison_may_have_cells_of_noise(tmp_path):
    common = replace(config("gnn-16"), learning=replace(config("gnn-16").learning, noise_cells=4))
    assert find("gnn-16").create(common, 1, tmp_path).model.noise is None


@pytest.mark.parametrize("algo", ["gnn-16", "transformer-16"])
def test_updates_reduce_the_critic_loss_of_a_fixed_batch(algo, tmp_path):
    model = model_of(algo, tmp_path / "run")
    model.hyperparameters = replace(model.hyperparameters, actor_start=0)
    env, generator = model.get_env(), torch.Generator().manual_seed(0)
    now = torch.as_tensor(env.reset()).repeat(4, 1, 1)
    now[..., :FEATURES] += torch.randn(now[..., :FEATURES].shape, generator=generator)
    count = now.shape[1]
    actions = 2 * torch.rand(8, 2 * count, generator=generator) - 1
    rewards = actions.mean(1, keepdim=True)
    batch = ReplayBufferSamples(now, actions, now, torch.ones(8, 1), rewards)
    weights = copy.deepcopy(model.networks()[0].state_dict())
    losses = [float(model.update(batch)["critic_loss"]) for _ in range(20)]
    assert np.mean(losses[-5:]) < 0.1 * np.mean(losses[:5])
    assert any(not torch.equal(weights[name], value) for name, value in model.networks()[0].state_dict().items())


def test_replay_holds_rows_and_node_actions(tmp_path):
    model = model_of("gnn-64", tmp_path / "run")
    model.learn(20)
    buffer = model.replay_buffer
    assert buffer.observations.shape[1:] == (2, 64, 14) and buffer.actions.shape[1:] == (2, 128)
    assert np.isfinite(buffer.observations[:10]).all() and np.abs(buffer.actions[:10]).max() > 0
    assert np.array_equal(buffer.next_observations[:9], buffer.observations[1:10])


def test_policy_of_a_file_acts_like_the_one_in_training(tmp_path):
    """In the training environment and attached to one of its own, step by step."""
    model = model_of("gnn-16", tmp_path / "run")
    nodes = Nodes(16, True)
    description = describe_run(Modular.preset("run", "quick"), "gnn-16", 1, 0)
    SegmentPolicy(model.networks()[0], nodes, description).save(tmp_path / "a.safetensors")
    policy = baselines.load(tmp_path / "a.safetensors")
    env = TorchEnv("run", 2, 64, particles=200, substeps=2)
    env.reset(seed=0)
    venv = model.get_env()
    venv.seed(0)
    seen, memory, images = venv.reset(), None, np.zeros((2, 3, 64, 64), np.uint8)
    for step in range(5):
        start = np.full(2, step == 0)
        action, memory = policy.attached(env).predict(images, memory, start, True)
        with torch.no_grad():
            env.step(torch.as_tensor(action))
        seen = venv.step(model.predict(seen, deterministic=True)[0])[0]
    assert torch.allclose(env.state.x, venv.unwrapped.torch_env.env.state.x, atol=1e-6)
    assert np.array_equal(memory[0].shape, (2, 200)) and action.shape == (2, 2, 64, 64)


@pytest.mark.parametrize("trained", ["image", "grid"])
def test_policy_answers_in_the_orientation_that_it_was_trained_in(trained):
    """Whatever the environment's, because teachers and pages turn its actions from the one that it says."""
    about = {"resolution": 64, "environment": {"action_layout": trained}}
    policy = SegmentPolicy(ModularActor("gnn", FEATURES), Nodes(16, True), about)
    images, actions = np.zeros((1, 3, 64, 64), np.uint8), {}
    for layout in ("image", "grid"):
        env = TorchEnv("run", 1, 64, particles=200, substeps=20, action_layout=layout)
        env.reset(seed=0)
        actions[layout] = policy.attached(env).predict(images, deterministic=True)[0]
        segments = SegmentedEnv(env, policy.nodes)
        segments.reset(seed=0)
        values = policy.actor(segments.env_state.observation, True).detach()
        segments.step(values)
        moved = env.state.x
        env.reset(seed=0)
        env.step(from_grid_layout(to_grid_layout(torch.from_numpy(actions[layout]), trained), layout))
        assert torch.equal(env.state.x, moved)
    assert np.array_equal(*actions.values())


def test_robots_are_segmented_anew_where_their_episode_begins_and_nowhere_else():
    policy = SegmentPolicy(ModularActor("gnn", FEATURES), Nodes(16, True), {"resolution": 64})
    env = TorchEnv("run", 2, 64, particles=200, substeps=2)
    env.reset(seed=0)
    images, policy = np.zeros((2, 3, 64, 64), np.uint8), policy.attached(env)
    _, (first,) = policy.predict(images)
    env.step(torch.zeros(2, 2, 64, 64))
    memory = (15 - first,)  # the same segments under other names, which are kept from step to step
    for start in (None, np.ones(2, bool)):  # evaluate_policy says True of a robot that has played its episodes
        _, (labels,) = policy.predict(images, memory, start)
        assert (labels == memory[0]).mean() > 0.9
    env.reset(options={"reset_mask": torch.tensor([True, False])})
    _, (labels,) = policy.predict(images, memory, np.zeros(2, bool))
    assert np.array_equal(labels[0], first[0]) and (labels[1] == memory[0][1]).mean() > 0.9


@pytest.mark.parametrize("case", [Case("lost", action_dropout=0.5), Case("noisy", action_noise=0.3)])
def test_faults_hit_segments_and_not_the_nodes_that_are_painted_from_them(case, monkeypatch):
    own = replace(config("gnn-16"), task="shapematch")
    policy = SegmentPolicy(ModularActor("gnn", FEATURES), Nodes(16, True), {"resolution": 64, "deterministic": True})
    fields, step = [], TorchVecEnv.step_async
    monkeypatch.setattr(TorchVecEnv, "step_async", lambda env, actions: fields.append(actions) or step(env, actions))
    report(own, policy, [case], 1)
    field = np.concatenate(fields)
    assert len(np.unique(field[0, 0])) <= 16
    assert (field == 0).mean() == pytest.approx(case.action_dropout, abs=0.1)
    assert field.std(axis=(2, 3)).mean() > 0.1 * (case.action_noise > 0)


def test_policy_must_be_shown_its_own_kind_of_task(tmp_path):
    policy = SegmentPolicy(ModularActor("gnn", FEATURES), Nodes(16, True), {"resolution": 64})
    with pytest.raises(RuntimeError, match="call attached"):
        policy.predict(np.zeros((1, 3, 64, 64), np.uint8))
    env = TorchEnv("catch", 1, 64, particles=(100, 20))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="10 features, got 'catch' with 16"):
        policy.attached(env)
    policy.save(tmp_path / "a.safetensors")
    with pytest.raises(CheckpointError, match="description"):
        SegmentPolicy.load(tmp_path / "a.safetensors")


@pytest.mark.parametrize("algo", ["gnn", "gnn-x", "mlp-16", "gnn-1"])
def test_bad_names_are_refused(algo):
    with pytest.raises(ConfigError, match=f"algo.*{algo}"):
        ModularConfig(algo=algo, task="run").check()


def test_fewer_particles_than_segments_are_refused():
    for particles in (63, (63, 100)):
        options = ModularConfig(algo="gnn-64", task="kick", environment=EnvironmentConfig(particles=particles))
        with pytest.raises(ConfigError, match=r"particles.*63"):
            options.check()


@pytest.mark.parametrize("graph", [False, True])
def test_matter_that_flew_off_leaves_finite_what_is_seen(graph):
    env = TorchEnv("shapematch", resolution=64, particles=200, substeps=1)
    env.reset(seed=0)
    nodes = Nodes(16, graph)
    labels = fit(visible_positions(env), 16)
    particles = env.state.clone()
    particles.x[0, 0], particles.v[0, 0] = 1e25, 1e30  # finite, and out of the window: the episode goes on
    env.env_state = replace(env.env_state, particles=particles)
    labels = update(visible_positions(env), labels, 16)
    rows = nodes.observe(env, labels)
    assert rows.isfinite().all() and rows.abs().max() < 1e6
    field = nodes.to_grid(env, labels, torch.rand(1, 16, 2))
    _, _, _, _, info = env.step(field)
    assert info["finite"].all()
