"""Segments of a robot, what is seen of them, and how they act."""

import pytest
import torch

import dittogym
from baselines.common.reference_policies import wave
from baselines.modular.env import SegmentedEnv
from baselines.modular.kmeans import adjacency, connect, fit, segment_means, squared_distances, update
from baselines.modular.nodes import LENGTH_SCALE, SPEED_SCALE, Nodes, pack, unpack
from cfp.errors import ConfigError
from dittogym import TorchEnv
from dittogym.action import place
from dittogym.geometry import centre_in_window


def segmented(task="run", num_envs=2, count=16, graph=True, **options):
    options = {"particles": 400, "substeps": 20, **options}
    env = SegmentedEnv(TorchEnv(task, num_envs, dittogym.make_spec(task).patch, **options), Nodes(count, graph))
    env.reset(seed=0)
    return env


def inertia(x, labels, count):
    return squared_distances(x, segment_means(x, labels, count)[0]).gather(2, labels[..., None]).mean()


@pytest.mark.parametrize("count", [16, 64])
def test_segments_last_while_the_robot_moves(count):
    """At the lite tier with the full physics: few particles change segment, and the clustering stays a good one."""
    env = segmented(num_envs=1, count=count, particles="lite", substeps=100)
    drive = wave(12, 64, env.env.action_layout)
    shares = []
    for action in drive:
        before = env.labels
        values = action[None, :, ::16, ::16].flatten(2).transpose(1, 2).repeat(1, 4, 1)[:, :count]
        env.step(values)
        shares.append(float((env.labels != before).float().mean()))
    x = env.env.state.x
    assert max(shares) < 0.05 and sum(shares) > 0
    assert inertia(x, env.labels, count) < 1.03 * inertia(x, fit(x, count), count)
    assert (segment_means(x, env.labels, count)[1] > 0).all()


def test_first_segments_are_seeded_and_the_same_in_a_batch_and_alone():
    x = torch.rand(2, 300, 2, generator=torch.Generator().manual_seed(0))
    labels = fit(x, 16)
    assert torch.equal(labels, fit(x, 16)) and not torch.equal(labels, fit(x, 16, seed=1))
    assert torch.equal(labels[1:], fit(x[1:], 16)) and labels.unique().tolist() == list(range(16))


def test_labels_of_a_rigid_motion_stay():
    x = torch.rand(1, 300, 2, generator=torch.Generator().manual_seed(0))
    labels = x.new_zeros(1, 300, dtype=torch.int64)
    for _ in range(60):
        labels = update(x, labels if labels.any() else fit(x, 8), 8)
    assert torch.equal(update(x + 3.0, labels, 8), labels)


def test_empty_segment_gets_the_farthest_particle():
    points = [[0.0, 0.0], [0.1, 0.0], [1.0, 0.0], [1.1, 0.0], [0.05, 0.0], [1.05, 0.0], [0.0, 0.3]]
    labels = update(torch.tensor([points]), torch.tensor([[0, 0, 1, 1, 2, 2, 0]]), 3)
    assert labels[0].tolist() == [0, 0, 1, 1, 0, 1, 2]  # the centre of 2 was half-way between the others


def test_more_segments_than_particles_are_refused():
    with pytest.raises(ConfigError, match=r"at least 16.*got 10"):
        fit(torch.rand(1, 10, 2), 16)


def test_neighbours_touch():
    """Three blocks in a row, the third at a distance: neighbours are the first two, the link is the shortest."""
    line = (torch.arange(20) + 0.5) / 20 * 0.1
    block = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1).flatten(0, 1)
    x = torch.cat([block, block + torch.tensor([0.1, 0.0]), block + torch.tensor([0.6, 0.0])])[None]
    centres = torch.tensor([[[0.05, 0.05], [0.15, 0.05], [0.65, 0.05]]])
    one = adjacency(x[:, :800], centres[:, :2])
    assert one[0].tolist() == [[False, True], [True, False]]
    assert adjacency(x, centres)[0].int().tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0]]


def test_parts_are_linked_by_the_shortest_edges_only_where_needed():
    edges = torch.zeros(2, 4, 4, dtype=torch.bool)
    edges[0, 0, 1] = edges[0, 1, 0] = edges[0, 2, 3] = edges[0, 3, 2] = True
    edges[1] = ~torch.eye(4, dtype=torch.bool)
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [4.0, 0.0]]).expand(2, -1, -1)
    joined = connect(edges, torch.cdist(points, points))
    new = (joined & ~edges).nonzero().tolist()
    assert new == [[0, 1, 2], [0, 2, 1]]


@pytest.mark.parametrize("count", [16, 20, 64])
def test_neighbours_survive_packing(count):
    edges = torch.rand(2, count, count, generator=torch.Generator().manual_seed(0)) < 0.4
    packed = pack(edges)
    assert packed.dtype == torch.float32 and packed.shape == (2, count, -(-count // 16))
    assert torch.equal(unpack(packed, count), edges.float())


def test_rows_say_what_the_segments_are():
    env = segmented("catch", 1)
    state, robot = env.env.env_state, env.env.model.num_robot_particles
    state.particles.v[:] = torch.rand(state.particles.v.shape, generator=torch.Generator().manual_seed(0))
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


@pytest.mark.parametrize(("task", "columns"), [("run", 10), ("grow", 12), ("kick", 14), ("dig", 12), ("slot", 14)])
def test_what_is_seen_depends_on_the_task(task, columns):
    assert Nodes(16, False).num_columns(dittogym.make_spec(task)) == columns


@pytest.mark.parametrize("task", ["run", "dig"])
def test_nodes_of_the_grid_get_the_value_of_the_nearest_segment(task):
    env = segmented(task, 1)
    values = torch.stack((torch.linspace(-1, 1, 16), torch.linspace(1, 0, 16)), -1)[None]
    action = env.nodes.to_grid(env.env, env.labels, values)
    state, spec = env.env.env_state, env.env.spec
    centre = centre_in_window(spec.patch_centre, state.centre, state.origin)
    field = place(action, centre, 128)
    robot = state.particles.x[:, : env.env.model.num_robot_particles]
    centres, _ = segment_means(robot, env.labels, 16)
    for point in robot[0, ::50]:
        i, j = ((point - state.origin[0]) * 128).round().long().tolist()
        node = state.origin[0] + torch.tensor([i, j]) / 128
        nearest = int((centres[0] - node).norm(dim=-1).argmin())
        assert field[0, :, i, j].tolist() == pytest.approx(values[0, nearest].tolist(), abs=1e-6)


def test_reset_of_some_leaves_the_others_alone():
    env = segmented()
    env.step(torch.rand(2, 16, 2))
    labels, seen = env.labels.clone(), env.env_state[2].clone()
    rows, _ = env.reset(options={"reset_mask": torch.tensor([False, True])})
    assert torch.equal(env.labels[0], labels[0]) and torch.equal(rows[0], seen[0])
    assert not torch.equal(rows[1], seen[1])


def test_simulation_that_is_not_finite_is_seen_as_it_was():
    env = segmented()
    seen, labels = env.env_state[2].clone(), env.labels.clone()
    env.env.state.x[1, :10] = torch.nan
    rows, _, terminated, _, info = env.step(torch.zeros(2, 16, 2))
    assert info["finite"].tolist() == [True, False] and terminated.tolist() == [False, True]
    assert torch.equal(rows[1], seen[1]) and torch.equal(env.labels[1], labels[1]) and rows.isfinite().all()
