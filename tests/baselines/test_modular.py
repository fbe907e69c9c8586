"""Modular policies: a robot's segments, what is seen of them, how they act, and the networks over them."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples

import baselines
import dittogym
from baselines.common.reference_policies import wave
from baselines.modular.learner import Modular
from baselines.modular.networks import ModularActor, ModularCritics, SegmentPolicy
from baselines.modular.segments import (
    LENGTH_SCALE,
    SPEED_SCALE,
    Nodes,
    SegmentedEnv,
    adjacency,
    fit,
    pack,
    segment_means,
    squared_distances,
    update,
    visible_positions,
)
from baselines.registry import configure, find
from cfp.errors import ConfigError
from cfp.policy import describe_run
from dittogym import Env, TorchEnv
from dittogym.action import from_grid_layout, place, to_grid_layout
from dittogym.geometry import centre_in_window

FEATURES = 10


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def segmented(task="run", num_envs=2, count=16, **options):
    options = {"particles": 400, "substeps": 20, **options}
    env = SegmentedEnv(TorchEnv(task, num_envs, dittogym.make_spec(task).patch, **options), Nodes(count, True))
    env.reset(seed=0)
    return env


# Segments -------------------------------------------------------------------------------------------------------------


def inertia(x, labels, count):
    return squared_distances(x, segment_means(x, labels, count)[0]).gather(2, labels[..., None]).mean()


@pytest.mark.parametrize("count", [16, 64])
def test_segments_last_while_the_robot_moves(count):
    """At the lite tier with the full physics: few particles change segment, and the clustering stays a good one."""
    env, shares = segmented(num_envs=1, count=count, particles="lite", substeps=100), []
    for action in wave(12, 64, env.env.action_layout):
        before = env.labels
        env.step(action[None, :, ::16, ::16].flatten(2).transpose(1, 2).repeat(1, 4, 1)[:, :count])
        shares.append(float((env.labels != before).float().mean()))
    x = env.env.state.x
    assert max(shares) < 0.05 and sum(shares) > 0
    assert inertia(x, env.labels, count) < 1.03 * inertia(x, fit(x, count), count)
    assert (segment_means(x, env.labels, count)[1] > 0).all()


def test_segments_are_seeded_stay_in_a_rigid_motion_and_need_particles():
    x = torch.rand(2, 300, 2, generator=seeded())
    labels = fit(x, 16)
    assert torch.equal(labels, fit(x, 16))
    assert torch.equal(labels[1:], fit(x[1:], 16)) and labels.unique().tolist() == list(range(16))
    for _ in range(30):
        labels = update(x, labels, 16)
    assert torch.equal(update(x + 3.0, labels, 16), labels)
    with pytest.raises(ConfigError, match=r"at least 16.*got 10"):
        fit(torch.rand(1, 10, 2), 16)


def test_empty_segment_gets_the_farthest_particle():
    points = [[0.0, 0.0], [0.1, 0.0], [1.0, 0.0], [1.1, 0.0], [0.05, 0.0], [1.05, 0.0], [0.0, 0.3]]
    labels = update(torch.tensor([points]), torch.tensor([[0, 0, 1, 1, 2, 2, 0]]), 3)
    assert labels[0].tolist() == [0, 0, 1, 1, 0, 1, 2]  # the centre of 2 was half-way between the others


def test_neighbours_touch():
    """Three blocks in a row, the third at a distance: neighbours are the first two, the link is the shortest."""
    line = (torch.arange(20) + 0.5) / 20 * 0.1
    block = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).flatten(0, 1)
    x = torch.cat([block, block + torch.tensor([0.1, 0.0]), block + torch.tensor([0.6, 0.0])])[None]
    centres = torch.tensor([[[0.05, 0.05], [0.15, 0.05], [0.65, 0.05]]])
    assert adjacency(x[:, :800], centres[:, :2])[0].tolist() == [[False, True], [True, False]]
    assert adjacency(x, centres)[0].int().tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0]]


def test_rows_say_what_the_segments_are():
    env = segmented("catch", 1)
    state, robot = env.env.env_state, env.env.model.num_robot_particles
    state.particles.v[:] = torch.rand(state.particles.v.shape, generator=seeded())
    rows = env.nodes.observe(env.env, env.labels)
    mine = env.labels[0] == 5
    x, v = state.particles.x[0, :robot], state.particles.v[0, :robot]
    centre = x[mine].mean(0)
    wanted = torch.cat(
        (
            (centre - x.mean(0)) / LENGTH_SCALE,
            v[mine].mean(0) / SPEED_SCALE,
            x[mine].std(0, correction=0) * 4 / LENGTH_SCALE,
            mine.float().mean()[None] * 16,
            (centre[1:] - 20 / 128) / LENGTH_SCALE,
            torch.zeros(2),
            (torch.tensor([0.15, 0.25]) - centre) / LENGTH_SCALE,
            (state.particles.x[0, robot:].mean(0) - centre) / LENGTH_SCALE,
            (state.particles.v[0, robot:].mean(0) - v[mine].mean(0)) / SPEED_SCALE,
        )
    )
    assert torch.allclose(rows[0, 5, :16], wanted, atol=1e-4) and rows.shape == (1, 16, 17)
    columns = {task: Nodes(16, False).num_columns(dittogym.make_spec(task)) for task in ("run", "grow", "kick", "dig")}
    assert columns == {"run": 10, "grow": 12, "kick": 14, "dig": 12}


@pytest.mark.parametrize("task", ["run", "dig"])
def test_nodes_of_the_grid_get_the_value_of_the_nearest_segment(task):
    env = segmented(task, 1)
    values = torch.stack((torch.linspace(-1, 1, 16), torch.linspace(1, 0, 16)), -1)[None]
    action = env.nodes.to_grid(env.env, env.labels, values)
    state, spec = env.env.env_state, env.env.spec
    field = place(action, centre_in_window(spec.patch_centre, state.centre, state.origin), 128)
    robot = state.particles.x[:, : env.env.model.num_robot_particles]
    centres, _ = segment_means(robot, env.labels, 16)
    for point in robot[0, ::50]:
        i, j = ((point - state.origin[0]) * 128).round().long().tolist()
        node = state.origin[0] + torch.tensor([i, j]) / 128
        nearest = int((centres[0] - node).norm(dim=-1).argmin())
        assert field[0, :, i, j].tolist() == pytest.approx(values[0, nearest].tolist(), abs=1e-6)


def test_simulation_that_is_not_finite_is_seen_as_it_was():
    env = segmented()
    before, labels = env.env_state.observation.clone(), env.labels.clone()
    env.env.state.x[1, :10] = torch.nan
    rows, _, terminated, _, info = env.step(torch.zeros(2, 16, 2))
    assert info["finite"].tolist() == [True, False] and terminated.tolist() == [False, True]
    assert torch.equal(rows[1], before[1]) and torch.equal(env.labels[1], labels[1]) and rows.isfinite().all()


@pytest.mark.parametrize(("x", "v", "goes_on"), [(50.0, 1e3, True), (1e25, 1e30, False)])
def test_matter_that_flew_off_leaves_finite_what_is_seen(x, v, goes_on):
    env, nodes = TorchEnv("shapematch", resolution=64, particles=200, substeps=1), Nodes(16, True)
    env.reset(seed=0)
    labels = fit(visible_positions(env), 16)
    particles = env.state.clone()
    particles.x[0, 0], particles.v[0, 0] = x, v
    env.env_state = replace(env.env_state, particles=particles)
    labels = update(visible_positions(env), labels, 16)
    rows = nodes.observe(env, labels)
    assert rows.isfinite().all() and rows.abs().max() < 1e6
    assert env.step(nodes.to_grid(env, labels, torch.rand(1, 16, 2)))[-1]["finite"].all() == goes_on


# Networks -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["gnn", "transformer"])
def test_networks_have_single_precision_whatever_that_of_torch_is(kind):
    """Double as torch's default, or less under autocast; so have the segments that they see."""
    torch.set_default_dtype(torch.float64)
    env = segmented()
    actor = ModularActor(kind, env.nodes.num_features(env.env.spec))
    rows, *_ = env.step(torch.zeros(2, 16, 2, dtype=torch.float32))
    torch.set_default_dtype(torch.float32)
    assert {rows.dtype, *(parameter.dtype for parameter in actor.parameters())} == {torch.float32}
    with torch.autocast("cpu", torch.bfloat16):
        assert actor.sample(rows).action.dtype == torch.float32


@pytest.mark.parametrize("kind", ["gnn", "transformer"])
@pytest.mark.parametrize("count", [16, 64])
def test_permutation_of_segments_permutes_the_actions(kind, count):
    torch.manual_seed(0)
    actor, critics = ModularActor(kind, FEATURES), ModularCritics(kind, FEATURES)
    features, order = torch.randn(3, count, FEATURES), torch.randperm(count)
    edges = torch.rand(3, count, count) < 0.3
    edges = edges | edges.transpose(1, 2)
    rows, other = features, features[:, order]
    if kind == "gnn":
        rows = torch.cat((rows, pack(edges)), -1)
        other = torch.cat((other, pack(edges[:, order][:, :, order])), -1)
    actions = actor(rows, True)
    assert actions.shape == (3, count, 2) and actions.std() > 1e-3
    assert torch.allclose(actor(other, True), actions[:, order], atol=1e-5)
    for value, same in zip(critics(rows, actions), critics(other, actions[:, order].flatten(1)), strict=True):
        assert value.shape == (3, 1) and torch.allclose(value, same, atol=1e-5)


def test_messages_go_along_edges_only():
    torch.manual_seed(0)
    actor, features = ModularActor("gnn", FEATURES), torch.randn(1, 6, FEATURES)
    edges = torch.zeros(1, 6, 6, dtype=torch.bool)
    for i in range(5):  # a chain; three rounds reach three nodes far
        edges[0, i, i + 1] = edges[0, i + 1, i] = True
    changed = features.clone()
    changed[0, 0] += 1.0
    before, after = (actor(torch.cat((each, pack(edges)), -1), True)[0] for each in (features, changed))
    assert ((before - after).abs().amax(-1) > 1e-7).tolist() == [True, True, True, True, False, False]


def config(algo):
    values = {"algo": algo, "task": "run", "device": "cpu", "steps": 40, "random_steps": 10, "num_envs": 2}
    values |= {"particles": 200, "substeps": 2, "eval_episodes": 1, "batch_size": 8, "buffer_size": 60}
    return configure(values | {"update_start": 8, "critics_first": 0.0})


@pytest.mark.parametrize("algo", ["gnn-16", "transformer-16"])
def test_updates_reduce_the_critic_loss_of_a_fixed_batch(algo, tmp_path):
    model, generator = find(algo).create(config(algo), 1, tmp_path), seeded()
    now = torch.as_tensor(model.get_env().reset()).repeat(4, 1, 1)
    now[..., :FEATURES] += torch.randn(now[..., :FEATURES].shape, generator=generator)
    actions = 2 * torch.rand(8, 2 * now.shape[1], generator=generator) - 1
    batch = ReplayBufferSamples(now, actions, now, torch.ones(8, 1), actions.mean(1, keepdim=True))
    weights = copy.deepcopy(model.networks()[0].state_dict())
    losses = [float(model.update(batch)["critic_loss"]) for _ in range(20)]
    assert np.mean(losses[-5:]) < 0.1 * np.mean(losses[:5])
    assert any(not torch.equal(weights[name], value) for name, value in model.networks()[0].state_dict().items())


# The policy -----------------------------------------------------------------------------------------------------------


def untrained(**description):
    return SegmentPolicy(ModularActor("gnn", FEATURES), Nodes(16, True), {"resolution": 64} | description)


def test_policy_of_a_file_acts_like_the_one_in_training(tmp_path):
    """In the training environment and attached to one of its own, step by step."""
    model = find("gnn-16").create(config("gnn-16"), 1, tmp_path)
    model.save_policy(tmp_path / "a.safetensors", describe_run(Modular.preset("run", "quick"), "gnn-16", 1, 0))
    policy = baselines.load(tmp_path / "a.safetensors")
    env = TorchEnv("run", 2, 64, particles=200, substeps=2)
    env.reset(seed=0)
    venv = model.get_env()
    venv.seed(0)
    rows, memory, images = venv.reset(), None, np.zeros((2, 3, 64, 64), np.uint8)
    for step in range(5):
        action, memory = policy.attached(env).predict(images, memory, np.full(2, step == 0), True)
        with torch.no_grad():
            env.step(torch.as_tensor(action))
        rows = venv.step(model.predict(rows, deterministic=True)[0])[0]
    assert torch.allclose(env.state.x, venv.unwrapped.torch_env.env.state.x, atol=1e-6)
    assert np.array_equal(memory[0].shape, (2, 200)) and action.shape == (2, 2, 64, 64)


@pytest.mark.parametrize("trained", ["image", "grid"])
def test_policy_answers_in_the_orientation_that_it_was_trained_in(trained):
    """Whatever the environment's, because teachers and pages turn its actions from the one that it says."""
    policy, actions = untrained(environment={"action_layout": trained}), {}
    for layout in ("image", "grid"):
        env = TorchEnv("run", 1, 64, particles=200, substeps=20, action_layout=layout)
        env.reset(seed=0)
        actions[layout] = policy.attached(env).predict(np.zeros((1, 3, 64, 64), np.uint8), deterministic=True)[0]
        segments = SegmentedEnv(env, policy.nodes)
        segments.reset(seed=0)
        segments.step(policy.actor(segments.env_state.observation, True).detach())
        moved = env.state.x
        env.reset(seed=0)
        env.step(from_grid_layout(to_grid_layout(torch.from_numpy(actions[layout]), trained), layout))
        assert torch.equal(env.state.x, moved)
    assert np.array_equal(*actions.values())


def test_robots_are_segmented_anew_where_their_episode_begins_and_nowhere_else():
    env = TorchEnv("run", 2, 64, particles=200, substeps=2)
    env.reset(seed=0)
    images, policy = np.zeros((2, 3, 64, 64), np.uint8), untrained().attached(env)
    _, (first,) = policy.predict(images)
    env.step(torch.zeros(2, 2, 64, 64))
    memory = (15 - first,)  # the same segments under other names, which are kept from step to step
    for start in (None, np.ones(2, bool)):  # evaluate_policy says True of a robot that has played its episodes
        _, (labels,) = policy.predict(images, memory, start)
        assert (labels == memory[0]).mean() > 0.9
    env.reset(options={"reset_mask": torch.tensor([True, False])})
    _, (labels,) = policy.predict(images, memory, np.zeros(2, bool))
    assert np.array_equal(labels[0], first[0]) and (labels[1] == memory[0][1]).mean() > 0.9


@pytest.mark.parametrize("kind", [torch.tensor, np.array, list])
def test_a_mask_may_lie_elsewhere_than_the_robots(kind):
    """Autoreset gives one on the host, whatever the device."""
    env = segmented(num_envs=3, substeps=2)
    first, _ = env.reset(seed=0)
    moved = env.step(2.0 * torch.rand(3, 16, 2, generator=seeded()) - 1.0)[0]
    rows, _ = env.reset(options={"reset_mask": kind([True, False, True])})
    assert torch.equal(rows[[0, 2]], first[[0, 2]]) and torch.equal(rows[1], moved[1])


def test_policy_must_be_shown_its_own_kind_of_task(tmp_path):
    policy = untrained()
    with pytest.raises(RuntimeError, match="attached"):
        policy.predict(np.zeros((1, 3, 64, 64), np.uint8))
    run = Env("run", resolution=64, particles=100, substeps=1)  # films show it the state by themselves
    assert len(run.film(policy, max_steps=2).rewards) == 2
    env = TorchEnv("catch", 1, 64, particles=(100, 20))
    with pytest.raises(ValueError, match="10 features, got 'catch' with 16"):
        policy.attached(env)
    with pytest.raises(ConfigError, match="description"):  # nobody could load it
        policy.save(tmp_path / "a.safetensors")
